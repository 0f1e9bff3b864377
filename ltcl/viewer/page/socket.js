// SPDX-License-Identifier: BSD-3-Clause
// Carrier of messages: the WebSocket of the page's server, which is tried again when it is gone.

const LONGEST_WAIT = 5000; // ms between two tries

export class SocketCarrier {
  listen({ message, lost }) {
    Object.assign(this, { message, lost, tries: 0 });
    this.connect();
  }

  get isOpen() {
    return this.socket.readyState === WebSocket.OPEN;
  }

  send(message) {
    this.socket.send(message);
  }

  close() {
    this.socket.onclose = null;
    this.socket.close();
  }

  connect() {
    const url = new URL("socket", location.href);
    url.protocol = url.protocol.replace("http", "ws");
    this.socket = new WebSocket(url);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({ data }) => {
      this.tries = 0;
      this.message(data);
    };
    this.socket.onclose = ({ reason }) => {
      this.lost(`Not connected${reason && `: ${reason}`}; trying again…`);
      this.checkAddress();
      setTimeout(() => this.connect(), Math.min(LONGEST_WAIT, 250 * 2 ** this.tries++));
    };
  }

  checkAddress() {
    fetch(location.pathname, { method: "HEAD" }).then(({ ok }) => {
      if (!ok) this.lost("The viewer was started again, with another address: open that one");
    }, () => {});
  }
}
