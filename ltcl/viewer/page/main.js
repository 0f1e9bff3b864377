// SPDX-License-Identifier: BSD-3-Clause
// The page: connection, tabs, the bar "Display", files that are opened or dropped.

import { bounces } from "./bounces.js";
import { compensate } from "./compensate.js";
import { Connection } from "./connection.js";
import { supported } from "./gl.js";
import { each, look } from "./panel.js";
import { probe } from "./probe.js";
import { relight } from "./relight.js";
import { scan } from "./scan.js";

const $ = (id) => document.getElementById(id);
const VIEWS = { probe, bounces, relight, compensate, scan };
const connection = new Connection();
const press = (button, on) => button.setAttribute("aria-pressed", on);
const app = { $, ask, press, connection };
const views = {};
let current = null;

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
  if (!text && kind && kind !== $("banner").dataset.kind) return;
  $("banner").dataset.kind = kind;
  $("banner").hidden = !text;
  if ($("banner").textContent !== text) $("banner").textContent = text;
}

connection.addEventListener("open", async ({ detail: hello }) => {
  const first = !app.hello, grids = (of) => String([of.grid, of.camera_grid]);
  if (!first && grids(app.hello) !== grids(hello)) location.reload(); // another T
  app.hello = hello;
  say("");
  $("title").textContent = document.title = hello.title;
  const error = hello.error ? `, error ${(100 * hello.error).toPrecision(2)} %` : ""; // 0 of a sketch
  const compressed = hello.compressed && `compressed${error}`;
  const size = hello.grid && `${hello.grid.join(" × ")} projector pixels`;
  const colours = hello.grid && (hello.channels === 3 ? "colour" : "grey");
  $("facts").textContent = [size, colours, compressed, hello.device].filter(Boolean).join(" · ");
  for (const tab of tabs) tab.hidden = !(tab.id === "tab-scan" ? hello.scan : hello.grid);
  document.body.classList.toggle("empty", !hello.grid); // an acquisition that has no transport yet
  $("tab-bounces").disabled = !hello.bounces;
  $("tab-bounces").title = hello.bounces ? "" : "Bounces need a camera grid equal to the projector’s";
  await known();
  if (first) {
    for (const name in VIEWS) if (!$(`tab-${name}`).hidden) views[name] = VIEWS[name](app);
    addEventListener("hashchange", route);
    route();
  } else views[current].start();
});

connection.addEventListener("lost", ({ detail: reason }) => {
  say(`Not connected${reason && `: ${reason}`}; trying again…`);
  fetch(location.pathname, { method: "HEAD" }).then(({ ok }) => {
    if (!ok) say("The viewer was started again, with another address: open that one");
  }, () => {});
});
connection.addEventListener("ready", () => { $("progress").hidden = true; });
connection.addEventListener("progress", ({ detail: { residual } }) => {
  const share = Math.min(Math.max(-Math.log10(residual) / 3 || 0, 0.03), 1); // of the way to 1e-3
  $("progress").hidden = false;
  $("progress").firstElementChild.style.width = `${100 * share}%`;
  $("progress").setAttribute("aria-valuenow", Math.round(100 * share));
});

// ---- views

const tabs = [...$("tabs").children];

function route() {
  const wanted = location.hash.slice(1);
  const name = views[wanted] && !$(`tab-${wanted}`).disabled ? wanted : Object.keys(views)[0];
  if (name === current) return;
  if (current) views[current].stop?.();
  current = name;
  for (const tab of tabs) {
    const chosen = tab.id === `tab-${name}`;
    tab.setAttribute("aria-selected", chosen);
    tab.tabIndex = chosen ? 0 : -1;
    $(tab.getAttribute("aria-controls")).hidden = !chosen;
  }
  views[name].start();
  each((panel) => panel.redraw());
}

const visit = (tab) => {
  location.hash = tab.id.slice(4);
  tab.focus();
};
$("tabs").addEventListener("click", ({ target }) => target.role === "tab" && visit(target));
$("tabs").addEventListener("keydown", ({ key }) => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[key];
  const open = tabs.filter((tab) => !tab.hidden && !tab.disabled), at = open.indexOf(document.activeElement);
  if (step) visit(open[(at + step + open.length) % open.length]);
});

// ---- display

function display(change) {
  Object.assign(look, change);
  look.stops = Math.min(Math.max(look.stops, -8), 8);
  $("stops").value = look.stops;
  $("stops-value").textContent = (look.stops > 0 ? "+" : "") + look.stops;
  press($("logarithmic"), look.logarithmic);
  each((panel) => panel.redrawSoon());
}

const brighter = () => display({ stops: look.stops + 0.5 });
const darker = () => display({ stops: look.stops - 0.5 });
const logarithmic = () => display({ logarithmic: !look.logarithmic });
const KEYS = { "+": brighter, "=": brighter, "-": darker, l: logarithmic, L: logarithmic };
$("stops").oninput = () => display({ stops: Number($("stops").value) });
$("mode").onchange = () => display({ mode: Number($("mode").value) });
for (const [id, act] of Object.entries({ darker, brighter, logarithmic })) $(id).onclick = act;
$("white").onclick = () => {
  each((panel) => { panel.white = panel.measured; });
  display({ stops: 0 });
};
addEventListener("keydown", ({ key, target, ctrlKey, metaKey, altKey }) => {
  if (target.tagName !== "SELECT" && !ctrlKey && !metaKey && !altKey) KEYS[key]?.();
});

// ---- pictures

async function known() {
  const answer = await ask("pictures");
  if (answer) app.pictures = answer.pictures;
  for (const select of document.querySelectorAll("select[id$=source]")) {
    const chosen = select.value, first = select.dataset.first ? [new Option(select.dataset.first, "")] : [];
    select.replaceChildren(...first, ...(app.pictures ?? []).map(({ picture, name }) => new Option(name, picture)));
    select.value = chosen;
    if (select.selectedIndex < 0) select.selectedIndex = 0;
  }
}

// What becomes of pictures of other proportions: one choice for all views, which the one in sight follows.
const resizes = [...document.querySelectorAll("select[id$=resize]")];
for (const select of resizes) {
  select.onchange = () => {
    for (const other of resizes) other.value = select.value;
    const source = $(`${current}-source`);
    if (source.value) source.dispatchEvent(new Event("change"));
  };
}

// Give a file to the view in sight: it takes it itself, or the server does, and the view gets its number.
async function give(file) {
  const view = current;
  if (await views[view].take?.(file)) return;
  const address = `picture?name=${encodeURIComponent(file.name)}`;
  const { error, picture } = await (await fetch(address, { method: "POST", body: file })).json();
  if (error) throw new Error(error);
  await known();
  const select = $(`${view}-source`);
  if (!select || view !== current) return;
  select.value = picture;
  select.dispatchEvent(new Event("change"));
}

const open = (file) => give(file).catch(({ message }) => say(`${file.name}: ${message}`, "pictures"));

for (const input of document.querySelectorAll("input[type=file]")) {
  input.onchange = () => {
    if (input.files[0]) open(input.files[0]);
    input.value = ""; // so that the same file can be opened again
  };
}
addEventListener("dragover", (event) => {
  event.preventDefault();
  document.body.classList.add("dropping");
});
addEventListener("dragleave", () => document.body.classList.remove("dropping"));
addEventListener("drop", (event) => {
  event.preventDefault();
  document.body.classList.remove("dropping");
  if (event.dataTransfer.files[0] && current) open(event.dataTransfer.files[0]);
});

$("open-projector").onclick = (event) => {
  if (window.open("projector", "ltcl-projector", "popup,width=960,height=600")) event.preventDefault();
};
if (!supported) say("This page needs WebGL 2, which this browser does not offer");
