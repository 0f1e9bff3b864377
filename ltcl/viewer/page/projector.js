// SPDX-License-Identifier: BSD-3-Clause
// The projector's window: one pixel of the pattern on a square of whole display pixels, without smoothing.

import { Connection } from "./connection.js";

const canvas = document.getElementById("show"), hint = document.getElementById("hint");
const connection = new Connection();

function fit() {
  const display = [innerWidth * devicePixelRatio, innerHeight * devicePixelRatio];
  const scale = Math.max(1, Math.floor(Math.min(display[0] / canvas.width, display[1] / canvas.height)));
  canvas.style.width = `${(scale * canvas.width) / devicePixelRatio}px`;
  canvas.style.height = `${(scale * canvas.height) / devicePixelRatio}px`;
}

connection.addEventListener("open", async ({ detail }) => {
  document.title = `${detail.title}: projector`;
  await connection.ask("projector");
  document.body.dataset.state = "ready";
});
connection.addEventListener("lost", () => { document.body.dataset.state = "lost"; }); // the pattern stays
connection.addEventListener("show", ({ detail: { arrays: { codes } } }) => {
  if (canvas.width !== codes.w || canvas.height !== codes.h) {
    [canvas.width, canvas.height] = [codes.w, codes.h];
    fit();
  }
  const context = canvas.getContext("2d"), image = context.createImageData(codes.w, codes.h);
  for (let i = 0; i < codes.h * codes.w; i++) {
    for (let k = 0; k < 3; k++) image.data[4 * i + k] = codes.data[i * codes.c + (codes.c === 3 ? k : 0)];
    image.data[4 * i + 3] = 255;
  }
  context.putImageData(image, 0, 0);
  canvas.dataset.frame = Number(canvas.dataset.frame ?? 0) + 1;
});

async function full() {
  if (document.fullscreenElement) await document.exitFullscreen();
  else await document.documentElement.requestFullscreen();
}
addEventListener("resize", fit);
addEventListener("click", full);
addEventListener("keydown", ({ key, target }) => key.toLowerCase() === "f" && target !== hint && full());
addEventListener("fullscreenchange", () => {
  hint.hidden = Boolean(document.fullscreenElement);
  document.body.classList.toggle("quiet", hint.hidden);
});
