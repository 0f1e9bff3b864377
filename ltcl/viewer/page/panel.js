// SPDX-License-Identifier: BSD-3-Clause
// One picture with its title, zoom, cursor and the values under the pointer.

import { Layers, draw } from "./gl.js";

const STEPS = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
const HYSTERESIS = 6; // white follows a picture that is brighter, or darker by this factor: no flicker

// The pixel in the middle of a projector's pattern, as [row, column].
export function middle({ grid: [h, w], left }) {
  return [h >> 1, left + (w >> 1)];
}

export class Panel {
  // `app` has the `panels` and the `look` of them all, the bar "Display". `element` is an empty <figure>.
  // `grid` is [h, w]. `act(kind, row, col, event)` hears what pointer and keys do: "hover", "press", "drag",
  // "release", "leave". `parts` are the projectors whose patterns stand side by side: [{ name, grid, left }].
  constructor(app, element, { title, grid, act = () => {}, parts = [] }) {
    Object.assign(this, { app, element, grid, act, parts, layers: new Layers(), white: 0, zoom: 1 });
    const [first] = parts;
    this.cursor = first ? middle(first) : grid.map((n) => n >> 1);
    element.classList.add("panel");
    element.parentElement.classList.toggle("wide", grid[1] > 2.3 * grid[0]); // pictures that are larger stacked
    element.append(app.$("panel").content.cloneNode(true));
    const find = (selector) => element.querySelector(selector);
    Object.assign(this, { canvas: find("canvas"), frame: find(".frame"), sheet: find(".sheet") });
    Object.assign(this, { mark: find(".cursor"), output: find(".values") });
    find(".title").textContent = title;
    this.canvas.id = `${element.id}-canvas`;
    this.output.id = `${element.id}-values`;
    this.canvas.setAttribute("aria-label", title);
    this.canvas.setAttribute("aria-describedby", this.output.id);
    [this.canvas.height, this.canvas.width] = grid;
    const [out, into] = element.querySelectorAll(".zoom button");
    out.onclick = () => this.zoomBy(1 / 1.5);
    into.onclick = () => this.zoomBy(1.5);
    this.names = document.createElement("div");
    if (parts.length) this.divide();
    this.listen();
    this.observer = new ResizeObserver(() => this.fit());
    this.observer.observe(this.frame);
    this.frame.style.setProperty("--aspect", grid[1] / grid[0]);
    app.panels.add(this);
  }

  // Names of the projectors in a row above the picture, and a border around the pattern of each.
  divide() {
    const [h, w] = this.grid;
    this.element.classList.add("several");
    this.names.className = "names";
    this.frame.before(this.names);
    for (const { name, grid: [height, width], left } of this.parts) {
      const border = document.createElement("span"), label = document.createElement("b");
      border.className = "part";
      label.textContent = name;
      label.style.width = `${(100 * width) / w}%`;
      const box = { left: left / w, width: width / w, height: height / h };
      for (const [side, share] of Object.entries(box)) border.style[side] = `${100 * share}%`;
      this.sheet.append(border);
      this.names.append(label);
    }
  }

  dispose() {
    this.observer.disconnect();
    cancelAnimationFrame(this.soon);
    this.layers.clear();
  }

  set note(text) {
    this.element.querySelector(".note").textContent = text;
  }

  // Show linear pictures of one size, summed with `weights`; `white` is measured where it is not known.
  show(pictures, weights = [1], white = undefined) {
    this.layers.set([pictures].flat());
    this.weights = weights;
    this.measured = white ?? this.layers.pictures[0].white();
    if (this.measured > this.white || this.measured < this.white / HYSTERESIS) this.white = this.measured;
    this.redraw();
  }

  redraw() {
    if (!this.layers.pictures || !this.element.offsetParent) return; // hidden ones are drawn later
    const { look } = this.app, white = (this.white || 1) / 2 ** look.stops;
    const { wipe, others, deviation, weights, mode = look.mode } = this;
    draw(this.canvas, this.layers, { ...look, white, mode, weights, others, wipe, deviation });
    this.canvas.dataset.white = white;
    this.read();
  }

  redrawSoon() {
    this.soon ??= requestAnimationFrame(() => {
      this.soon = undefined;
      this.redraw();
    });
  }

  listen() {
    const { canvas } = this, fingers = new Map();
    let spread = 0, grip = null;
    const distance = () => {
      const [a, b] = [...fingers.values()];
      return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
    };
    canvas.addEventListener("pointerdown", (event) => {
      fingers.set(event.pointerId, event);
      canvas.setPointerCapture(event.pointerId);
      if (fingers.size === 2) {
        spread = distance();
        this.act("release");
      } else if (event.button === 1 || event.button === 2 || event.shiftKey) {
        grip = [event.clientX + this.frame.scrollLeft, event.clientY + this.frame.scrollTop];
      } else this.point("press", event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (fingers.has(event.pointerId)) fingers.set(event.pointerId, event);
      if (fingers.size === 2) {
        this.zoomBy(distance() / spread, event);
        spread = distance();
      } else if (grip) this.frame.scrollTo(grip[0] - event.clientX, grip[1] - event.clientY);
      else this.point(fingers.size ? "drag" : "hover", event);
    });
    const up = (event) => {
      if (fingers.delete(event.pointerId) && !fingers.size && !grip) this.act("release", ...this.cursor);
      grip = null;
    };
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, up);
    canvas.addEventListener("pointerleave", () => this.act("leave", ...this.cursor));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    this.frame.addEventListener("wheel", (event) => {
      if (this.app.embedded && !event.ctrlKey && !event.metaKey) return; // it scrolls the notebook
      event.preventDefault();
      this.zoomBy(Math.exp(-event.deltaY / 400), event);
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("keyup", ({ key }) => {
      if (key !== " " && key !== "Enter") return;
      this.pressed = false;
      this.act("release", ...this.cursor);
    });
  }

  key(event) {
    const step = STEPS[event.key];
    if (!step && event.key !== " " && event.key !== "Enter") return;
    event.preventDefault();
    if (step) {
      const far = event.shiftKey ? 10 : 1;
      this.moveTo(...this.cursor.map((at, axis) => at + far * step[axis]));
      this.mark.scrollIntoView({ block: "nearest", inline: "nearest" });
      this.act(this.pressed ? "drag" : "hover", ...this.cursor, event);
    } else if (!event.repeat) {
      this.pressed = true; // arrow keys drag until the key is released
      this.act("press", ...this.cursor, event);
    }
  }

  point(kind, event) {
    const box = this.canvas.getBoundingClientRect();
    const col = Math.floor(((event.clientX - box.left) / box.width) * this.grid[1]);
    const row = Math.floor(((event.clientY - box.top) / box.height) * this.grid[0]);
    this.moveTo(row, col);
    this.act(kind, ...this.cursor, event);
  }

  moveTo(row, col) {
    this.cursor = [row, col].map((at, axis) => Math.min(Math.max(at, 0), this.grid[axis] - 1));
    this.read();
  }

  // Draw a ring round the cursor, `size` pixels wide; 0 takes it away.
  ring(size = 1) {
    const [h, w] = this.grid, [row, col] = this.cursor, { style } = this.mark;
    this.mark.hidden = !size;
    style.left = `${((col + 0.5) / w) * 100}%`;
    style.top = `${((row + 0.5) / h) * 100}%`;
    style.width = `max(12px, ${(size / w) * 100}%)`;
  }

  values(row, col) {
    return this.layers.pictures ? this.layers.at(row, col, this.weights) : [];
  }

  read() {
    const [row, col] = this.cursor;
    const names = ["R\u00a0", "G\u00a0", "B\u00a0"];
    const format = (v) => (Math.abs(v) < 1e-3 && v ? v.toExponential(2) : v.toFixed(4));
    const text = this.values(row, col).map((v, k, all) => (all.length === 3 ? names[k] : "") + format(v));
    const part = this.parts.find(({ grid, left }) => row < grid[0] && col >= left && col < left + grid[1]);
    const place = part ? `${part.name}: row ${row}, column ${col - part.left}` : `row ${row}, column ${col}`;
    this.output.textContent = `${place}   ${text.join("   ")}`;
  }

  fit() {
    const { clientWidth, clientHeight } = this.frame, [h, w] = this.grid;
    if (!clientWidth) return;
    const scale = Math.min(clientWidth / w, clientHeight / h) * this.zoom;
    this.frame.classList.toggle("zoomed", this.zoom > 1);
    this.sheet.style.width = `${scale * w}px`;
    this.sheet.style.height = `${scale * h}px`;
    this.names.style.width = `${Math.min(scale * w, clientWidth)}px`;
    this.canvas.classList.toggle("smooth", scale * devicePixelRatio < 1);
  }

  // About the pointer, else about the middle of what is in sight.
  zoomBy(factor, event) {
    const { frame } = this, box = frame.getBoundingClientRect(), before = this.sheet.getBoundingClientRect();
    const x = event?.clientX ?? box.left + box.width / 2, y = event?.clientY ?? box.top + box.height / 2;
    const [u, v] = [(x - before.left) / before.width, (y - before.top) / before.height];
    this.zoom = Math.min(Math.max(this.zoom * factor, 1), 64);
    this.fit();
    const after = this.sheet.getBoundingClientRect();
    frame.scrollLeft += after.left + u * after.width - x;
    frame.scrollTop += after.top + v * after.height - y;
  }
}
