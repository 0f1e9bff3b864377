// SPDX-License-Identifier: BSD-3-Clause
// The viewer, in a page or in the widget of a notebook: what it says, its views, and what it begins and ends with.

import { bounces } from "./bounces.js";
import { compensate } from "./compensate.js";
import { display } from "./display.js";
import { files } from "./files.js";
import { ready } from "./gl.js";
import { probe } from "./probe.js";
import { relight } from "./relight.js";
import { scan } from "./scan.js";
import { tabs } from "./tabs.js";

const VIEWS = { probe, bounces, relight, compensate, scan };
const press = (button, on) => button.setAttribute("aria-pressed", on);

// `root` is a Document or a ShadowRoot that holds viewer.html. `place` is what stands around it: `embedded` in
// a notebook, `keys` hears keys, `wanted()` and `visit(name)` are of the view in sight, `entitle(text)` takes the
// title, `restart()` begins anew. Returns a function that ends it all.
export function viewer(root, connection, place) {
  const $ = (id) => root.getElementById(id), every = (selector) => [...root.querySelectorAll(selector)];
  const frame = root.querySelector(".viewer"), ended = new AbortController();
  // `panels` are all that there are, `look` how they show light: the bar "Display".
  const app = { ...place, $, every, root, frame, connection, ask, say, press, hear, panels: new Set(), views: {} };
  app.look = { stops: 0, logarithmic: false, mode: 0 };
  app.each = (change) => app.panels.forEach(change);
  const route = tabs(app), known = files(app);
  display(app);
  connection.mark(frame);

  // Until all ends.
  function hear(target, event, act) {
    target.addEventListener(event, act, { signal: ended.signal });
  }

  // The answer to a question; null where a newer one replaced it, or where it was refused, which is shown.
  async function ask(kind, fields, arrays) {
    try {
      const answer = await connection.ask(kind, fields, arrays);
      if (answer) say("", kind);
      return answer;
    } catch (error) {
      say(error.message, kind);
      return null;
    }
  }

  // What is wrong with a question of this kind; an answer to one takes that away, and nothing else.
  function say(text, kind = "") {
    const banner = $("banner");
    if (!text && kind && kind !== banner.dataset.kind) return;
    banner.dataset.kind = kind;
    banner.hidden = !text;
    if (banner.textContent !== text) banner.textContent = text;
  }

  function introduce(hello) {
    const { title, grid, camera_grid, channels, scan: isScan, bounces: hasBounces, compressed, error, device } = hello;
    const { projectors = [] } = hello;
    $("title").textContent = title;
    place.entitle(title);
    const names = projectors.map(({ name, grid: own }) => `${name} ${own.join(" × ")}`).join(", ");
    const size = grid && `${names || grid.join(" × ")} projector pixels`, colours = grid && (channels === 3 ? "colour" : "grey");
    const known = error ? `, error ${(100 * error).toPrecision(2)} %` : ""; // 0 of a sketch
    if (grid) frame.style.setProperty("--grid-aspect", camera_grid[1] / camera_grid[0]);
    $("facts").textContent = [size, colours, compressed && `compressed${known}`, device].filter(Boolean).join(" · ");
    for (const tab of every("[role=tab]")) tab.hidden = !(tab.id === "tab-scan" ? isScan : grid);
    frame.classList.toggle("empty", !grid); // an acquisition that has no transport yet
    $("tab-bounces").disabled = !hasBounces;
    $("tab-bounces").title = hasBounces ? "" : "Bounces need a camera grid equal to the projector’s";
  }

  hear(connection, "open", async ({ detail: hello }) => {
    const first = !app.hello, grids = (of) => String([of.grid, of.camera_grid]);
    if (!first && grids(app.hello) !== grids(hello)) place.restart(); // another T
    app.hello = hello;
    say("");
    introduce(hello);
    await known();
    if (ended.signal.aborted) return;
    if (first) {
      for (const name in VIEWS) if (!$(`tab-${name}`).hidden) app.views[name] = VIEWS[name](app);
      route();
    } else app.views[app.current].start();
  });
  hear(connection, "lost", ({ detail: words }) => say(words));
  hear(connection, "waiting", ({ detail: words }) => say(words, "waiting"));
  hear(connection, "heard", () => say("", "waiting"));
  hear(connection, "ready", () => { $("progress").hidden = true; });
  hear(connection, "progress", ({ detail: { residual } }) => {
    const share = Math.min(Math.max(-Math.log10(residual) / 3 || 0, 0.03), 1); // of the way to 1e-3
    $("progress").hidden = false;
    $("progress").firstElementChild.style.width = `${100 * share}%`;
    $("progress").setAttribute("aria-valuenow", Math.round(100 * share));
  });
  if (!ready()) say("This page needs WebGL 2, which this browser does not offer");

  return () => {
    ended.abort();
    connection.carrier.close();
    for (const view of Object.values(app.views)) {
      view.stop?.();
      view.dispose?.();
    }
    app.each((panel) => panel.dispose());
  };
}
