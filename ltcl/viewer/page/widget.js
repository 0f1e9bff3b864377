// SPDX-License-Identifier: BSD-3-Clause
// The viewer as the widget of a notebook (https://anywidget.dev), over the kernel's own channel. It stands in a
// shadow tree: no style, identifier or key goes in or out.

import { CommCarrier } from "./comm.js";
import { Connection } from "./connection.js";
import { release } from "./gl.js";
import { viewer } from "./viewer.js";

// Landmarks and the heading are for a page of its own.
const ROLES = { header: "presentation", main: "presentation", footer: "group" };

// With it JupyterLab leaves keys to an element: those that we hear, and not Ctrl-S.
const ALONE = "data-lm-suppress-shortcuts";

let shown = 0; // views of this module

function show(root, model, markup, style) {
  root.innerHTML = `<style>${style}</style>${markup}`;
  for (const [name, role] of Object.entries(ROLES)) root.querySelector(name).role = role;
  root.getElementById("title").ariaLevel = 3;
  let view = "", end = null;
  const restart = () => {
    end();
    end = show(root, model, markup, style);
  };
  const place = {
    embedded: true,
    keys: root,
    wanted: () => view,
    visit: (name) => { view = name; },
    entitle: () => {},
    restart,
  };
  const connection = new Connection(new CommCarrier(model)), image = still(model.get("still"));
  root.getElementById("banner").after(image);
  connection.addEventListener("open", () => image.remove());
  end = viewer(root, connection, place);
  return () => end();
}

// The picture that Python made, until it answers; a saved notebook may have no kernel that does.
function still(bytes) {
  const image = new Image();
  Object.assign(image, { className: "still", alt: "The viewer as it begins" });
  image.onload = image.onerror = () => URL.revokeObjectURL(image.src);
  image.src = URL.createObjectURL(new Blob([bytes ?? ""], { type: "image/png" }));
  return image;
}

export function widget(markup, style) {
  return {
    render({ model, el }) {
      const host = document.createElement("div"), root = host.attachShadow({ mode: "open" });
      host.className = model.get("name"); // by which the picture after it knows that it is here
      Object.assign(host, { role: "region", ariaLabel: "ltcl viewer" });
      const alone = ({ ctrlKey, metaKey, altKey }) => host.toggleAttribute(ALONE, !(ctrlKey || metaKey || altKey));
      addEventListener("keydown", alone, true);
      el.append(host);
      const end = show(root, model, markup, style);
      shown++;
      return () => {
        end();
        removeEventListener("keydown", alone, true);
        host.remove();
        if (!--shown) release();
      };
    },
  };
}
