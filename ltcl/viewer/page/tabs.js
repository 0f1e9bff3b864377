// SPDX-License-Identifier: BSD-3-Clause
// Tabs: which view is in sight.

export function tabs(app) {
  const { $, every, views, hear } = app, all = every("[role=tab]");

  function route() {
    const wanted = app.wanted();
    const name = views[wanted] && !$(`tab-${wanted}`).disabled ? wanted : Object.keys(views)[0];
    if (name === app.current) return;
    if (app.current) views[app.current].stop?.();
    app.current = name;
    for (const tab of all) {
      const chosen = tab.id === `tab-${name}`;
      tab.setAttribute("aria-selected", chosen);
      tab.tabIndex = chosen ? 0 : -1;
      $(tab.getAttribute("aria-controls")).hidden = !chosen;
    }
    views[name].start();
    app.each((panel) => panel.redraw());
  }

  function visit(tab) {
    app.visit(tab.id.slice(4));
    route();
    tab.focus();
  }

  hear(window, "hashchange", () => app.current && route());
  hear($("tabs"), "click", ({ target }) => target.role === "tab" && visit(target));
  hear($("tabs"), "keydown", ({ key }) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[key];
    const open = all.filter((tab) => !tab.hidden && !tab.disabled), at = open.indexOf(app.root.activeElement);
    if (step) visit(open[(at + step + open.length) % open.length]);
  });
  return route;
}
