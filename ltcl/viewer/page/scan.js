// SPDX-License-Identifier: BSD-3-Clause
// Scan: photographs of an acquisition as they come, their exposure, how far it is, and what is wrong.

const percent = (share) => `${(100 * share).toFixed(1)} %`;

const PERIOD = 1000; // ms between two looks into the folder

export function scan({ $, ask, press, hello, restart }) {
  const list = $("scan-photographs"), most = 24; // as many as the server keeps
  let seen = 0, timer = null;

  function facts({ state, done, total, what, left, coverage, saturated, notes = [] }) {
    Object.assign($("scan-progress"), { max: total || 1, value: done });
    const minutes = Math.round(left / 60), calibrated = coverage !== undefined;
    $("scan-facts").textContent = [
      ...notes,
      state === "final" ? "finished" : `${done} of about ${total} ${what}`,
      left !== null && (minutes ? `about ${minutes} min left` : "less than a minute left"),
      calibrated && `camera sees ${percent(coverage)} of the projector`,
      calibrated && `${percent(saturated)} of the camera saturated`,
    ].filter(Boolean).join(" · ");
  }

  // Show how many pixels have which code.
  function choose(button, text, histogram) {
    for (const each of list.children) press(each, each === button);
    $("scan-exposure").textContent = text;
    const depth = (share) => Math.min(30, -7.5 * Math.log10(share + 1e-9)); // four decades
    const points = histogram.map((share, k) => `${(100 * (k + 0.5)) / histogram.length},${depth(share)}`);
    $("scan-histogram").firstElementChild.setAttribute("points", points.join(" "));
  }

  function add({ name, time, seconds, histogram }, codes) {
    [...list.children].find(({ dataset }) => dataset.name === name)?.remove(); // taken again
    const button = $("photograph").content.cloneNode(true).firstElementChild, [canvas, caption] = button.children;
    Object.assign(button.dataset, { name, time });
    [canvas.width, canvas.height] = [codes.w, codes.h];
    canvas.getContext("2d").putImageData(codes.image(), 0, 0);
    caption.textContent = seconds ? `${name}, ${seconds.toPrecision(3)} s` : name;
    if (histogram) button.onclick = () => choose(button, `Exposure of ${caption.textContent}`, histogram);
    const chosen = list.querySelector("[aria-pressed=true]"), first = list.firstElementChild;
    list.insertBefore(button, [...list.children].find(({ dataset }) => dataset.time < time) ?? null);
    if (list.children.length > most) list.lastElementChild.remove();
    if (button === list.firstElementChild && (!chosen || chosen === first)) button.click();
  }

  async function start() {
    clearTimeout(timer);
    const answer = await ask("scan", { seen });
    if (answer) {
      seen = answer.seen;
      facts(answer);
      answer.photographs.forEach((each, k) => add(each, answer.arrays[k]));
      const item = (textContent) => Object.assign(document.createElement("li"), { textContent });
      $("scan-warnings").replaceChildren(...answer.warnings.map(item));
      if (answer.finished && !hello.grid) restart();
    } else seen = 0; // the next viewer counts anew
    timer = setTimeout(start, PERIOD);
  }

  return { start, dispose: () => clearTimeout(timer) };
}
