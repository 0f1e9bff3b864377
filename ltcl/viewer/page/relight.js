// SPDX-License-Identifier: BSD-3-Clause
// Relight: paint on the projector's pattern, or let a picture, a video or a moving spot do it.

import { draw, Layers } from "./gl.js";
import { Pixels } from "./messages.js";
import { Panel, middle } from "./panel.js";

const UNDO = 30; // steps that can be undone

export function relight(app) {
  const { $, ask, press, hello } = app;
  const [h, w] = hello.grid;
  const canvas = () => pattern.canvas;
  const parts = hello.projectors, title = parts.length ? "Patterns of the projectors" : "Projector’s pattern";
  const pattern = new Panel(app, $("relight-pattern"), { title, grid: [h, w], act, parts });
  const seen = new Panel(app, $("relight-seen"), { title: "What the camera sees", grid: hello.camera_grid });
  const paint = canvas().getContext("2d", { willReadFrequently: true });
  const past = [], video = document.createElement("video");
  let erasing = false, last = null, changed = false, sending = 0, motion = null, turn = 0;
  Object.assign(video, { muted: true, loop: true, playsInline: true });
  paint.lineCap = "round";
  const size = $("relight-size"), source = $("relight-source"), resize = $("relight-resize");
  size.max = Math.max(8, Math.round(Math.max(h, w) / 3));
  size.value = Math.max(1, Math.round(Math.max(h, w) / 10));
  pattern.values = (row, col) => [...paint.getImageData(col, row, 1, 1).data.slice(0, 3)].map(linear);

  const linear = (code) => (code <= 10 ? code / 255 / 12.92 : ((code / 255 + 0.055) / 1.055) ** 2.4);

  const codes = () => new Pixels(paint.getImageData(0, 0, w, h).data, [h, w, 4]);

  const show = (light) => seen.show(light, [1], light.white(0.97)); // bounces are darker than what is lit

  // Send what is painted when an answer has come: one pattern is computed, one on its way, never more.
  async function send() {
    changed = true;
    canvas().dataset.frame = Number(canvas().dataset.frame ?? 0) + 1;
    if (sending === 2) return;
    sending++;
    while (changed) {
      changed = false;
      const answer = await ask("relight", {}, { pattern: codes() });
      if (answer) show(answer.arrays.picture);
    }
    sending--;
    pattern.read();
  }

  function act(kind, row, col) {
    pattern.ring(kind === "leave" ? 0 : Number(size.value));
    if (kind === "press") {
      begin();
      last = [row, col];
    } else if (kind !== "drag") last = null;
    if (!last) return;
    paint.strokeStyle = erasing ? "#000" : $("relight-colour").value;
    paint.lineWidth = Number(size.value);
    paint.beginPath();
    paint.moveTo(last[1] + 0.5, last[0] + 0.5);
    paint.lineTo(col + 0.5, row + 0.5 + 1e-3); // a line without length is not drawn
    paint.stroke();
    send();
    last = [row, col];
  }

  // Stop what moves, the spot or the video; and what is still to come is too late.
  function still() {
    turn++;
    cancelAnimationFrame(motion);
    video.pause();
    press($("relight-spot"), false);
  }

  // Before something else is painted.
  function begin() {
    still();
    past.push(paint.getImageData(0, 0, w, h));
    if (past.length > UNDO) past.shift();
  }

  function fill(style) {
    paint.fillStyle = style;
    paint.fillRect(0, 0, w, h);
    send();
  }

  function animate(frame) {
    const step = (now) => {
      motion = requestAnimationFrame(step);
      if (!changed) frame(now / 1000); // the last one is on its way
    };
    motion = requestAnimationFrame(step);
  }

  function spot(seconds) {
    glowAt(w * (0.5 + 0.4 * Math.sin(1.1 * seconds)), h * (0.5 + 0.4 * Math.sin(1.7 * seconds)));
  }

  // In the middle of one of several projectors: where they meet in the pattern they may light nothing.
  function first() {
    if (!parts.length) return spot(0.15);
    const [row, col] = middle(parts[0]);
    glowAt(col + 0.5, row + 0.5);
  }

  function glowAt(x, y) {
    const glow = paint.createRadialGradient(x, y, 0, x, y, Number(size.value));
    glow.addColorStop(0, $("relight-colour").value);
    glow.addColorStop(1, "#000");
    fill(glow);
  }

  // Draw a picture or a frame that only the browser reads, as `ltcl.images.resize` does.
  function place(image, width, height) {
    let [across, down] = [w / width, h / height];
    if (resize.value === "crop") across = down = Math.max(across, down);
    if (resize.value === "letterbox") across = down = Math.min(across, down);
    const [wide, high] = [across * width, down * height];
    paint.fillStyle = "#000";
    paint.fillRect(0, 0, w, h);
    paint.imageSmoothingQuality = "high";
    paint.drawImage(image, (w - wide) / 2, (h - high) / 2, wide, high);
    send();
  }

  async function take(file) {
    still();
    if (file.type.startsWith("video/")) {
      begin();
      source.value = "";
      const own = turn;
      URL.revokeObjectURL(video.src);
      video.src = URL.createObjectURL(file);
      await video.play().catch((error) => { if (own === turn) throw error; });
      if (own === turn) animate(() => place(video, video.videoWidth, video.videoHeight));
      return true;
    }
    const name = file.name.toLowerCase();
    if (hello.extensions.some((extension) => name.endsWith(extension))) return false; // the server reads it
    const own = turn, bitmap = await createImageBitmap(file).catch(() => null);
    if (!bitmap || own !== turn) return Boolean(bitmap);
    begin();
    source.value = "";
    place(bitmap, bitmap.width, bitmap.height);
    return true;
  }

  // What the server has as its pattern, as codes.
  function shown(light) {
    const layers = new Layers();
    layers.set([light]);
    draw(canvas(), layers, { white: 1, mode: 0, logarithmic: false, weights: [1] });
    layers.clear();
  }

  async function start(fields = {}) {
    const own = ++turn;
    changed = false;
    const answer = await ask("relight", fields);
    if (!answer || own !== turn) return;
    show(answer.arrays.picture);
    const light = answer.arrays.pattern;
    shown(light);
    // All white is how it begins, and leaves nothing to paint.
    if (!("picture" in fields) && light.data.every((stored) => stored === light.data[0])) first();
    pattern.read();
  }

  const tool = (eraser) => {
    erasing = eraser;
    press($("relight-brush"), !eraser);
    press($("relight-eraser"), eraser);
  };
  $("relight-brush").onclick = () => tool(false);
  $("relight-eraser").onclick = () => tool(true);
  for (const [name, style] of [["fill", () => $("relight-colour").value], ["clear", () => "#000"]]) {
    $(`relight-${name}`).onclick = () => {
      begin();
      fill(style());
    };
  }
  $("relight-undo").onclick = () => {
    still();
    if (past.length) paint.putImageData(past.pop(), 0, 0);
    send();
  };
  $("relight-spot").onclick = () => {
    if ($("relight-spot").getAttribute("aria-pressed") === "true") return still();
    begin();
    animate(spot);
    press($("relight-spot"), true);
  };
  source.onchange = () => {
    begin();
    if (source.value) start({ picture: Number(source.value), resize: resize.value });
  };
  return { start: () => start(), stop: still, take };
}
