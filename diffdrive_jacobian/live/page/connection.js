// The websocket to the server. It reconnects, and reports when it is lost.

const RETRY = 1000;

export class Connection {
  /** @param {(frame: object) => void} onFrame @param {(open: boolean) => void} onChange */
  constructor(onFrame, onChange) {
    this.onFrame = onFrame;
    this.onChange = onChange;
    this.socket = null;
    this.connect();
  }

  get open() {
    return this.socket !== null && this.socket.readyState === WebSocket.OPEN;
  }

  connect() {
    const address = new URL('socket', location.href);
    address.protocol = 'ws:';
    const socket = new WebSocket(address);
    this.socket = socket;
    socket.onopen = () => this.onChange(true);
    socket.onmessage = (event) => this.onFrame(JSON.parse(event.data));
    socket.onclose = () => {
      if (this.socket !== socket) return;
      this.onChange(false);
      setTimeout(() => this.connect(), RETRY);
    };
  }

  /** Send a command. Return whether the connection took it. */
  send(command) {
    // What waits in a connection that hangs would act much later.
    if (!this.open || this.socket.bufferedAmount > 4096) return false;
    this.socket.send(JSON.stringify(command));
    return true;
  }
}
