// SPDX-License-Identifier: BSD-3-Clause
// Scan: photographs of an acquisition as they come, their exposure, how far it is, and what is wrong.

const SHOWN = 24; // photographs
const percent = (share) => `${(100 * share).toFixed(1)} %`;

export function scan({ $, ask, press, connection }) {
  const list = $("scan-photographs");

  function time(seconds) {
    const [h, m, s] = [seconds / 3600, (seconds / 60) % 60, seconds % 60].map(Math.floor);
    return h ? `${h} h ${m} min` : m ? `${m} min` : `${s} s`;
  }

  function facts({ state, done, total, what, left, coverage, saturated }) {
    $("scan-progress").max = total || 1;
    $("scan-progress").value = done;
    const ended = state === "final", begun = coverage !== undefined;
    $("scan-facts").textContent = [
      ended ? "finished" : `${done} of about ${total} ${what}`,
      !ended && left !== null && `about ${time(left)} left`,
      begun && `camera sees ${percent(coverage)} of the projector`,
      begun && `${percent(saturated)} of the camera saturated`,
    ].filter(Boolean).join(" · ");
  }

  // Show how many pixels have which code.
  function choose(button, text, histogram) {
    for (const each of list.children) press(each, each === button);
    $("scan-exposure").textContent = text;
    const height = (share) => Math.max(0, 30 + 7.5 * Math.log10(share + 1e-9)); // four decades
    const points = histogram.map((share, k) => `${(100 * (k + 0.5)) / histogram.length},${30 - height(share)}`);
    $("scan-histogram").firstElementChild.setAttribute("points", points.join(" "));
  }

  function add({ name, seconds, histogram }, pixels) {
    [...list.children].find(({ dataset }) => dataset.name === name)?.remove(); // taken again
    const button = $("photograph").content.cloneNode(true).firstElementChild;
    const [canvas, caption] = button.children, context = canvas.getContext("2d");
    [canvas.width, canvas.height, button.dataset.name] = [pixels.w, pixels.h, name];
    const image = context.createImageData(pixels.w, pixels.h);
    for (let i = 0; i < image.data.length; i++) {
      image.data[i] = i % 4 === 3 ? 255 : pixels.data[(i >> 2) * pixels.c + (pixels.c === 3 ? i % 4 : 0)];
    }
    context.putImageData(image, 0, 0);
    caption.textContent = seconds ? `${name}, ${seconds.toPrecision(3)} s` : name;
    if (histogram) button.onclick = () => choose(button, `Exposure of ${caption.textContent}`, histogram);
    list.prepend(button);
    if (list.children.length > SHOWN) list.lastElementChild.remove();
    if (list.querySelector("[aria-pressed=true]") === null && histogram) button.click();
  }

  connection.addEventListener("scan", ({ detail }) => {
    facts(detail);
    detail.photographs.forEach((each, k) => each.name && add(each, detail.arrays[k]));
    const texts = detail.warnings.map((text) => Object.assign(document.createElement("li"), { textContent: text }));
    $("scan-warnings").replaceChildren(...texts);
  });
  connection.addEventListener("lost", () => list.replaceChildren()); // the server sends them again
  return { start: () => ask("scan") };
}
