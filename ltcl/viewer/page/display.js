// SPDX-License-Identifier: BSD-3-Clause
// The bar "Display": how all panels show light.

export function display(app) {
  const { $, look, press, hear } = app;

  function change(changed) {
    Object.assign(look, changed);
    look.stops = Math.min(Math.max(look.stops, -8), 8);
    $("stops").value = look.stops;
    $("stops-value").textContent = (look.stops > 0 ? "+" : "") + look.stops;
    press($("logarithmic"), look.logarithmic);
    app.each((panel) => panel.redrawSoon());
  }

  const brighter = () => change({ stops: look.stops + 0.5 });
  const darker = () => change({ stops: look.stops - 0.5 });
  const logarithmic = () => change({ logarithmic: !look.logarithmic });
  const keys = { "+": brighter, "=": brighter, "-": darker, l: logarithmic, L: logarithmic };
  $("stops").oninput = () => change({ stops: Number($("stops").value) });
  $("mode").onchange = () => change({ mode: Number($("mode").value) });
  for (const [id, act] of Object.entries({ darker, brighter, logarithmic })) $(id).onclick = act;
  $("white").onclick = () => {
    app.each((panel) => { panel.white = panel.measured; });
    change({ stops: 0 });
  };
  hear(app.keys, "keydown", ({ key, target, ctrlKey, metaKey, altKey }) => {
    if (target.tagName !== "SELECT" && !ctrlKey && !metaKey && !altKey) keys[key]?.();
  });
}
