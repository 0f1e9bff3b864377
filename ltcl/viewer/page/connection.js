// SPDX-License-Identifier: BSD-3-Clause
// The socket: questions with an answer each, news from the server, and trying again when it is gone.

import { decode, encode } from "./messages.js";

const LONGEST_WAIT = 5000; // ms between two tries

export class Connection extends EventTarget {
  // Events: "open" (with the server's greeting as detail), "lost", "busy", "idle", and one per push, by its name.
  constructor() {
    super();
    this.waiting = new Map(); // by the kind of question: [the one under way, the newest after it]
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
    this.socket.onclose = () => {
      for (const [now, next] of this.waiting.values()) for (const each of [now, next]) each?.answer(null);
      this.waiting.clear();
      this.tell("lost");
      setTimeout(() => this.connect(), Math.min(LONGEST_WAIT, 250 * 2 ** this.tries++));
    };
  }

  tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  // The answer, or null where a newer question of this kind took its place or the connection was lost:
  // one question of a kind is under way at a time, so that painting never queues. Errors are thrown.
  ask(kind, fields = {}, arrays = {}) {
    if (this.socket.readyState !== WebSocket.OPEN) return Promise.resolve(null);
    return new Promise((answer, fail) => {
      const question = { id: ++this.questions, kind, fields, arrays, answer, fail };
      const pair = this.waiting.get(kind);
      if (pair) {
        pair[1]?.answer(null);
        pair[1] = question;
      } else this.send(question);
    });
  }

  send(question) {
    this.waiting.set(question.kind, [question, null]);
    this.socket.send(encode({ id: question.id, do: question.kind, ...question.fields }, question.arrays));
    this.tell("busy");
  }

  receive(message) {
    const pair = this.waiting.get(message.do);
    if (message.do === "hello") {
      this.tries = 0;
      this.tell("open", message);
    } else if (!pair || pair[0].id !== message.id) {
      if (message.error) this.tell("refused", message.error);
      this.tell(message.do, message);
    } else {
      const [{ answer, fail }, next] = pair;
      this.waiting.delete(message.do);
      if (next) this.send(next);
      if (message.error) fail(new Error(message.error));
      else answer(message);
      if (!this.waiting.size) this.tell("idle");
    }
  }
}
