// SPDX-License-Identifier: BSD-3-Clause
// The projector's window: one pixel of the pattern on a square of whole display pixels, without smoothing.

import { Connection } from "./connection.js";
import { SocketCarrier } from "./socket.js";

const canvas = document.getElementById("show"), hint = document.getElementById("hint");
const connection = new Connection(new SocketCarrier());
connection.mark(document.body);

function fit() {
  const display = [innerWidth * devicePixelRatio, innerHeight * devicePixelRatio];
  const scale = Math.max(1, Math.floor(Math.min(display[0] / canvas.width, display[1] / canvas.height)));
  canvas.style.width = `${(scale * canvas.width) / devicePixelRatio}px`;
  canvas.style.height = `${(scale * canvas.height) / devicePixelRatio}px`;
}

let keys = false; // whether they are for what shows patterns one after the other

connection.addEventListener("open", async ({ detail }) => {
  keys = detail.next;
  await connection.ask("projector");
});
connection.addEventListener("show", async ({ detail: { title, arrays: { codes } } }) => {
  document.title = `${title}: projector`;
  if (canvas.width !== codes.w || canvas.height !== codes.h) {
    [canvas.width, canvas.height] = [codes.w, codes.h];
    fit();
  }
  canvas.getContext("2d").putImageData(codes.image(), 0, 0);
  canvas.dataset.frame = Number(canvas.dataset.frame ?? 0) + 1;
  await connection.ask("projector"); // it is drawn: the next one
});

async function full() {
  if (document.fullscreenElement) await document.exitFullscreen();
  else await document.documentElement.requestFullscreen();
}
addEventListener("resize", fit);
addEventListener("click", full);
addEventListener("keydown", ({ key }) => {
  if (key.toLowerCase() === "f") full();
  if (keys && [" ", "ArrowRight", "ArrowDown", "PageDown"].includes(key)) connection.ask("next");
});
addEventListener("fullscreenchange", () => {
  hint.hidden = Boolean(document.fullscreenElement);
  document.body.classList.toggle("quiet", hint.hidden);
});
