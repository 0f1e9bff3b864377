// SPDX-License-Identifier: BSD-3-Clause
// Probe: what a projector pixel lights (a column of T), or where a camera pixel's light comes from (a row).

import { Panel } from "./panel.js";

export function probe(app) {
  const { $, ask, press, hello } = app;
  const sides = {
    projector: {
      grid: hello.grid, parts: hello.projectors, title: hello.projectors.length ? "Projectors" : "Projector",
      kind: "column", array: "picture", other: "camera",
    },
    camera: { grid: hello.camera_grid, title: "Camera", kind: "row", array: "pattern", other: "projector" },
  };
  let source = "projector", held = false;

  for (const [name, side] of Object.entries(sides)) {
    const act = (kind, row, col, event) => heard(name, kind, event);
    side.panel = new Panel(app, $(`probe-${name}`), { ...side, act });
  }

  function heard(name, kind, event) {
    if (name !== source) {
      if (kind === "press") turn(name);
      return;
    }
    if (kind === "press" && event.pointerType !== "touch") held = !held;
    if (kind === "press" || kind === "drag" || (kind === "hover" && (!held || event.key))) look();
    sides[source].panel.note = held ? "held: click to let go" : "";
  }

  async function look() {
    const { panel, kind, array, other } = sides[source];
    panel.ring();
    const answer = await ask(kind, { pixel: panel.cursor });
    if (!answer || sides[source].kind !== kind) return;
    const light = answer.arrays[array];
    sides[other].panel.show(light, [1], light.white(0.95)); // direct light is far brighter
  }

  // From now on the ring is on this side, which shows the scene, or the pattern where that has another grid.
  function turn(name) {
    source = name;
    held = false;
    press($("probe-forward"), name === "projector");
    press($("probe-back"), name === "camera");
    for (const { panel } of Object.values(sides)) {
      panel.white = 0;
      panel.note = "";
      panel.ring(0);
    }
    start();
  }

  async function start() {
    const { panel, other } = sides[source];
    const forward = source === "projector";
    sides[other].panel.note = forward ? "what the ring’s pixel lights" : "where its light comes from";
    look();
    const now = await ask("relight");
    if (!now || sides[source].panel !== panel) return;
    panel.show(now.arrays[forward && !hello.square ? "pattern" : "picture"]);
  }

  $("probe-forward").onclick = () => turn("projector");
  $("probe-back").onclick = () => turn("camera");
  return { start };
}
