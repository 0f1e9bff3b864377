// SPDX-License-Identifier: BSD-3-Clause
// Carrier of messages: the kernel of a notebook, through the model of a widget. Each view of a model is a page of
// its own, and says in each message which.

const LARGEST_PART = 4 << 20; // bytes: servers of notebooks close a connection for messages of 10 MiB
const PATIENCE = 3000; // ms without an answer, or word that one is computed
const BUSY = "The kernel does not answer: it runs another cell, or has ended";

export class CommCarrier {
  constructor(model) {
    this.model = model;
    this.page = crypto.getRandomValues(new Uint32Array(3)).join("-");
    this.isOpen = true;
  }

  listen({ message, lost, waiting }) {
    this.hear = (content, buffers) => {
      if (content.page !== this.page) return;
      clearTimeout(this.timer);
      if (content.lost) lost(content.lost);
      else if (content.computing) waiting("");
      else message(content.text ?? whole(buffers[0]));
    };
    this.wait = () => {
      clearTimeout(this.timer);
      this.timer = setTimeout(() => waiting(BUSY), PATIENCE);
    };
    this.leave = () => this.close();
    this.model.on("msg:custom", this.hear);
    addEventListener("pagehide", this.leave);
    this.model.send({ page: this.page, event: "open" });
    this.wait();
  }

  send(message) {
    this.wait();
    if (typeof message === "string") {
      this.model.send({ page: this.page, text: message });
      return;
    }
    for (let start = 0; start < message.length; start += LARGEST_PART) {
      const more = start + LARGEST_PART < message.length;
      this.model.send({ page: this.page, more }, undefined, [message.slice(start, start + LARGEST_PART)]);
    }
  }

  close() {
    if (!this.isOpen) return;
    this.isOpen = false;
    clearTimeout(this.timer);
    removeEventListener("pagehide", this.leave);
    this.model.off("msg:custom", this.hear);
    this.model.send({ page: this.page, event: "close" });
  }
}

// The bytes of a DataView as a buffer of their own, whose arrays begin at multiples of 4.
const whole = ({ buffer, byteOffset, byteLength }) => buffer.slice(byteOffset, byteOffset + byteLength);
