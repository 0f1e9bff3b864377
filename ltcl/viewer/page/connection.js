// SPDX-License-Identifier: BSD-3-Clause
// The socket: questions with an answer each, news from the server, and trying again when it is gone.

import { decode, encode } from "./messages.js";

const LONGEST_WAIT = 5000; // ms between two tries
const AT_ONCE = { bounces: Infinity, compensate: Infinity }; // a newer one of these ends the one under way

export class Connection extends EventTarget {
  // Events: "open" (its detail is what the server says of T), "lost", "busy", "ready", and pushes by name.
  constructor() {
    super();
    for (const state of ["lost", "busy", "ready"]) {
      this.addEventListener(state, () => { document.body.dataset.state = state; });
    }
    this.kinds = new Map(); // of questions under way: those that were sent, and the newest after them
    this.questions = 0;
    this.tries = 0;
    this.connect();
  }

  connect() {
    const url = new URL("socket", location.href);
    url.protocol = url.protocol.replace("http", "ws");
    this.socket = new WebSocket(url);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({ data }) => this.receive(decode(data));
    this.socket.onclose = ({ reason }) => {
      for (const { sent, next } of this.kinds.values()) [...sent, next].forEach((each) => each?.answer(null));
      this.kinds.clear();
      this.tell("lost", reason);
      setTimeout(() => this.connect(), Math.min(LONGEST_WAIT, 250 * 2 ** this.tries++));
    };
  }

  tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  // The answer, or null where a newer question of this kind took its place or the connection was lost.
  // Errors are thrown. Painting never queues: a question waits here while two are under way.
  ask(kind, fields = {}, arrays = {}) {
    if (this.socket.readyState !== WebSocket.OPEN) return Promise.resolve(null);
    return new Promise((answer, fail) => {
      const queue = this.kinds.get(kind) ?? { sent: [], next: null };
      this.kinds.set(kind, queue);
      queue.next?.answer(null);
      queue.next = { id: ++this.questions, kind, fields, arrays, answer, fail };
      this.send(queue);
      this.tell("busy");
    });
  }

  send(queue) {
    if (!queue.next || queue.sent.length >= (AT_ONCE[queue.next.kind] ?? 2)) return;
    const { id, kind, fields, arrays } = queue.next;
    this.socket.send(encode({ id, do: kind, ...fields }, arrays));
    queue.sent.push(queue.next);
    queue.next = null;
  }

  receive(message) {
    const queue = this.kinds.get(message.do), at = queue?.sent.findIndex(({ id }) => id === message.id) ?? -1;
    if (message.do === "hello") {
      this.tries = 0;
      this.tell("open", message);
    } else if (at < 0) this.tell(message.do, message);
    else {
      const [question, ...older] = queue.sent.splice(0, at + 1).reverse();
      older.forEach((each) => each.answer(null)); // the server took a newer one in their place
      this.send(queue);
      if (!queue.sent.length) this.kinds.delete(message.do);
      if (typeof message.error === "string") question.fail(new Error(message.error)); // numbers are results
      else question.answer(message);
      if (!this.kinds.size) this.tell("ready");
    }
  }
}
