// SPDX-License-Identifier: BSD-3-Clause
// Compensate: the pattern that makes the scene look as desired, and how well that went.

import { Panel } from "./panel.js";

const KEPT = 60000; // ms in which the browser begins to save a file

const percent = (share) => (share && share < 1e-5 ? "below 0.001 %" : `${(100 * share).toPrecision(3)} %`);

export function compensate(app) {
  const { $, ask, hello } = app;
  const panel = (name, title, grid, act, parts) => new Panel(app, $(`compensate-${name}`), { title, grid, act, parts });
  const wipe = panel("wipe", "Predicted appearance", hello.camera_grid, (kind, row, col, event) => {
    if (kind === "press" || kind === "drag" || event?.key) part((col + 0.5) / hello.camera_grid[1]);
  });
  const target = panel("target", "Desired", hello.camera_grid);
  const pattern = panel("pattern", hello.projectors.length ? "Patterns" : "Pattern", hello.grid, undefined, hello.projectors);
  const reach = panel("reach", "Out of reach", hello.camera_grid);
  const line = document.createElement("span"), source = $("compensate-source");
  let solved = null, solves = 0; // the last certified compensation, and how many were asked for
  Object.assign(line, { className: "line", hidden: true });
  wipe.sheet.append(line);
  wipe.others = [0, 1];
  reach.mode = 2;

  function part(share) {
    line.hidden = false;
    wipe.wipe = share;
    line.style.left = `${100 * share}%`;
    wipe.redrawSoon();
  }

  const settings = () => {
    const [gain, low, high] = ["gain", "low", "high"].map((name) => Number($(`compensate-${name}`).value));
    return { picture: Number(source.value), gain, bounds: [low, high], resize: $("compensate-resize").value };
  };

  function showNumbers() {
    for (const name of ["gain", "low", "high"]) {
      $(`compensate-${name}-value`).textContent = $(`compensate-${name}`).value;
    }
  }

  // While a slider moves: as good as there is time for.
  async function adjust() {
    if (!source.value) return;
    showNumbers();
    const before = solves, answer = await ask("adjust", settings());
    if (!answer || !solved || before !== solves) return; // a solve was asked for since then
    const { arrays } = answer;
    wipe.show([arrays.appearance, solved.arrays.uncompensated], [1, 0], solved.arrays.target.white());
    pattern.show(arrays.pattern);
    wipe.note = `error ${percent(answer.error)}, 99 % of frames within ${(1000 * answer.p99).toPrecision(2)} ms`;
  }

  async function solve() {
    solves++;
    wipe.note = source.value ? "solving…" : "open or drop the picture that the scene should look like";
    if (!source.value) return;
    const [auto, gain, low, high] = ["auto", "gain", "low", "high"].map((name) => $(`compensate-${name}`));
    gain.disabled = auto.checked;
    $("compensate-low-value").textContent = low.value;
    $("compensate-high-value").textContent = high.value;
    if (!auto.checked) $("compensate-gain-value").textContent = gain.value;
    const bounds = [low, high].map(({ value }) => Number(value));
    const level = auto.checked ? "auto" : Number(gain.value);
    const picture = source.value, resize = $("compensate-resize").value;
    const answer = await ask("compensate", { picture: Number(picture), gain: level, bounds, resize });
    if (!answer || picture !== source.value || resize !== $("compensate-resize").value) return;
    solved = answer;
    const { arrays } = answer, white = arrays.target.white();
    wipe.note = "without ◂ ▸ with compensation";
    wipe.show([arrays.appearance, arrays.uncompensated], [1, 0], white);
    target.show(arrays.target, [1], white);
    pattern.show(arrays.pattern);
    const missed = arrays.out_of_reach.white(0.999);
    reach.show(arrays.out_of_reach, [1], Math.max(missed, white / 50));
    reach.note = missed ? "" : "nothing";
    if (wipe.wipe === undefined) part(0.5);
    if (auto.checked && level === "auto") {
      gain.value = answer.gain;
      $("compensate-gain-value").textContent = answer.gain.toPrecision(2);
    }
    report(answer);
  }

  function report(answer) {
    $("compensate-more").hidden = false;
    const lines = {
      Error: percent(answer.error), Gain: answer.gain.toPrecision(3), Clipped: percent(answer.clipped),
      Method: `${answer.method}, ${answer.products} products, ${answer.seconds.toPrecision(2)} s`,
    };
    const element = (tag, textContent) => Object.assign(document.createElement(tag), { textContent });
    const entries = Object.entries(lines).flatMap(([name, text]) => [element("dt", name), element("dd", text)]);
    $("compensate-report").replaceChildren(...entries);
    const logs = answer.residuals.filter((residual) => residual > 0).map(Math.log10);
    const top = Math.max(...logs, 0), low = Math.min(...logs, -1), step = 100 / Math.max(logs.length - 1, 1);
    const points = logs.map((log, k) => `${step * k},${1 + (28 * (top - log)) / (top - low)}`);
    $("compensate-residuals").firstElementChild.setAttribute("points", points.join(" "));
  }

  // Files of the last compensation, one after the other: a newer question would take the place of an older one.
  let saved = Promise.resolve();
  const save = (name) => { saved = saved.then(() => download(name)); };

  async function download(name) {
    const answer = await ask("result", { name });
    if (!answer) return;
    const href = URL.createObjectURL(new Blob([answer.arrays.content]));
    Object.assign(document.createElement("a"), { href, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(href), KEPT);
  }

  for (const button of $("compensate-downloads").querySelectorAll("button")) {
    button.onclick = () => save(button.dataset.file);
  }
  $("compensate-auto").oninput = solve;
  for (const name of ["gain", "low", "high"]) {
    // The largest gain of other bounds takes a solve.
    $(`compensate-${name}`).oninput = () => ($("compensate-auto").checked ? solve() : adjust());
    $(`compensate-${name}`).onchange = solve;
  }
  source.onchange = solve;
  return { start: solve };
}
