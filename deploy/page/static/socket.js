// A WebSocket that comes back by itself after the server was away.
const AGAIN_MS = 400;

export class Socket {
  constructor(path, { opened = () => {}, heard, closed = () => {}, binary = false }) {
    Object.assign(this, { path, opened, heard, closed, binary, ended: false });
    this.open();
  }

  open() {
    const socket = this.socket = new WebSocket(`${location.origin.replace(/^http/, "ws")}${this.path}`);
    if (this.binary) socket.binaryType = "arraybuffer";
    socket.onopen = () => this.opened(this);
    socket.onmessage = event => this.heard(event.data, this);
    socket.onclose = event => {
      this.closed(event);
      if (!this.ended) setTimeout(() => this.open(), AGAIN_MS);
    };
  }

  get ready() { return this.socket.readyState === WebSocket.OPEN; }

  send(text) { if (this.ready) this.socket.send(text); }

  end() { this.ended = true; this.socket.close(); }
}
