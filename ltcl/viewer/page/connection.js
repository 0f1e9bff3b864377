// SPDX-License-Identifier: BSD-3-Clause
// Questions with an answer each, and news from Python, over any carrier: a socket, or the kernel of a notebook.

import { decode, encode } from "./messages.js";

const AT_ONCE = { bounces: Infinity, compensate: Infinity }; // a newer one of these ends the one under way

export class Connection extends EventTarget {
  // `carrier` has `isOpen`, `send(message)`, `close()` and `listen({ message, lost, waiting })`: it opens itself,
  // and again, and tells of each message, a string or an ArrayBuffer; in words, that the other side is gone, and
  // that no answer comes, or "" where one will. Events: "open" (its detail is what Python says of T), "lost", "waiting", "heard"
  // after that, "busy", "ready", and pushes by name.
  constructor(carrier) {
    super();
    this.kinds = new Map(); // of questions under way: those that were sent, and the newest after them
    this.questions = 0;
    this.carrier = carrier;
    carrier.listen({
      message: (data) => this.receive(decode(data)),
      lost: (words) => this.lose(words),
      waiting: (words) => this.tell("waiting", words),
    });
  }

  lose(words) {
    for (const { sent, next } of this.kinds.values()) [...sent, next].forEach((each) => each?.answer(null));
    this.kinds.clear();
    this.tell("lost", words);
  }

  tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  // Let `element` say in its data what state the connection is in.
  mark(element) {
    for (const state of ["lost", "busy", "ready"]) {
      this.addEventListener(state, () => { element.dataset.state = state; });
    }
  }

  // The answer, or null where a newer question of this kind took its place or the connection was lost.
  // Errors are thrown. Painting never queues: a question waits here while two are under way.
  ask(kind, fields = {}, arrays = {}) {
    if (!this.carrier.isOpen) return Promise.resolve(null);
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
    this.carrier.send(encode({ id, do: kind, ...fields }, arrays));
    queue.sent.push(queue.next);
    queue.next = null;
  }

  receive(message) {
    this.tell("heard");
    const queue = this.kinds.get(message.do), at = queue?.sent.findIndex(({ id }) => id === message.id) ?? -1;
    if (message.do === "hello") this.tell("open", message);
    else if (at < 0) this.tell(message.do, message);
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
