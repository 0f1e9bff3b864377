// SPDX-License-Identifier: BSD-3-Clause
// The viewer as a page of its own, over a socket.

import { Connection } from "./connection.js";
import { SocketCarrier } from "./socket.js";
import { viewer } from "./viewer.js";

const place = {
  embedded: false,
  keys: window,
  wanted: () => location.hash.slice(1),
  visit: (name) => { location.hash = name; },
  entitle: (title) => { document.title = title; },
  restart: () => location.reload(),
};

viewer(document, new Connection(new SocketCarrier()), place);
document.getElementById("open-projector").onclick = (event) => {
  if (window.open("projector", "ltcl-projector", "popup,width=960,height=600")) event.preventDefault();
};
