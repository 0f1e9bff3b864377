// SPDX-License-Identifier: BSD-3-Clause
// Bounces: a picture as a sum of direct light and bounces, which sliders mix in the shader.

import { Layers, draw } from "./gl.js";
import { Panel } from "./panel.js";

const SECONDS = 1.2; // of a step of the film

export function bounces(app) {
  const { $, ask, press, hello } = app;
  const mix = new Panel(app, $("bounces-mix"), { title: "Mixed light", grid: hello.camera_grid });
  const deviation = new Layers(), stack = $("bounces-stack"), source = $("bounces-source");
  let sliders = [], film = null, turn = 0;
  if (source.options.length > 1) source.selectedIndex = 1;

  async function separate() {
    const own = ++turn;
    set(() => 1);
    const count = Number($("bounces-count").value);
    const kept = { picture: Number(source.value), resize: $("bounces-resize").value };
    const of = source.value ? kept : {}; // what the pattern looks like
    const answer = await ask("bounces", { ...of, count });
    if (!answer || own !== turn) return;
    const names = ["direct", ...Array.from({ length: count }, (_, k) => `bounce_${k + 1}`), "rest"];
    const pictures = names.map((name) => answer.arrays[name]);
    const known = "direct_std" in answer.arrays;
    mix.show(pictures, names.map(() => 1), pictures.reduce((sum, picture) => sum + picture.white(), 0));
    if (known) deviation.set(names.map((name, k) => answer.arrays[`${name}_std`] ?? nothing(pictures[k])));
    $("bounces-noise").hidden = $("bounces-pink").hidden = !known;
    sliders = pictures.map((picture, k) => row(picture, k, answer.shares[k]));
    stack.replaceChildren(...sliders.map(({ element }) => element));
    mixed();
  }

  // Of the rest.
  const nothing = ({ data, h, w, c }) => ({ data: data.slice().fill(0), h, w, c });

  function row(picture, k, share) {
    const last = mix.weights.length - 1;
    const name = k === 0 ? "Direct light" : k === last ? "All further bounces" : `Bounce ${k}`;
    const element = $("bounce").content.firstElementChild.cloneNode(true);
    const [canvas, title, output, slider] = element.children;
    const white = picture.white() || 1, layers = new Layers(), times = mix.white / white;
    title.firstElementChild.textContent = name;
    title.lastElementChild.textContent = `${(100 * share).toPrecision(2)}\u00a0% of the light` +
      (times > 1.5 ? `, shown ${times < 10 ? times.toFixed(1) : Math.round(times)}× brighter` : "");
    slider.value = sliders[k]?.slider.value ?? 1; // moved while this was computed
    layers.set([picture]);
    draw(canvas, layers, { white, mode: 0, logarithmic: false, weights: [1] });
    layers.clear();
    canvas.setAttribute("aria-label", `${name} alone`);
    slider.setAttribute("aria-label", `Strength of: ${name}`);
    slider.id = `bounces-${k}`;
    slider.oninput = () => {
      play(false);
      mixed();
    };
    return { element, slider, output };
  }

  function mixed() {
    mix.weights = sliders.map(({ slider }) => Number(slider.value));
    mix.weights.forEach((weight, k) => { sliders[k].output.textContent = weight.toFixed(2); });
    mix.deviation = $("bounces-uncertain").checked && !$("bounces-noise").hidden ? deviation : undefined;
    mix.redrawSoon();
  }

  function set(weights) {
    sliders.forEach(({ slider }, k) => { slider.value = weights(k); });
    mixed();
  }

  // The film: bounce after bounce is added to direct light, as if light were slow.
  function play(on) {
    press($("bounces-film"), on);
    cancelAnimationFrame(film);
    if (!on) return;
    const jumps = matchMedia("(prefers-reduced-motion: reduce)").matches, begin = performance.now();
    const frame = (now) => {
      const time = ((now - begin) / 1000 / SECONDS) % (sliders.length + 1); // one step of rest at the end
      set((k) => (jumps ? Number(time >= k) : Math.min(Math.max(time - k + 1, 0), 1)));
      mix.note = time < 1 ? "direct light" : `with ${Math.min(Math.floor(time), sliders.length - 1)} bounces`;
      film = requestAnimationFrame(frame);
    };
    film = requestAnimationFrame(frame);
  }

  $("bounces-film").onclick = () => {
    const on = $("bounces-film").getAttribute("aria-pressed") !== "true";
    play(on);
    if (!on) set(() => 1);
    mix.note = "";
  };
  $("bounces-reset").onclick = () => {
    play(false);
    set(() => 1);
  };
  $("bounces-uncertain").onchange = mixed;
  source.onchange = $("bounces-count").onchange = separate;
  return { start: separate, stop: () => play(false) };
}
