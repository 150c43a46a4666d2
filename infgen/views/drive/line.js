// The line to the server: messages both ways, and what to say when it is cut.

const BUSY = 1013;
const TRIES = 6;
const WAIT_MS = 400;

export class Line {
  /**
   * @param {Object} hear what to do with a message, by its type
   * @param {(text: string) => void} cut called when the line is cut for good
   */
  constructor(hear, cut) {
    [this.hear, this.cut, this.tries] = [hear, cut, 0];
    this.open();
  }

  open() {
    this.socket = new WebSocket(`ws://${location.host}${location.pathname}line`);
    this.socket.addEventListener("message", (event) => {
      const message = JSON.parse(event.data);
      this.hear[message.type](message);
    });
    this.socket.addEventListener("close", (event) => {
      // A page that was just left may still have the seat.
      if (event.code === BUSY && ++this.tries < TRIES) setTimeout(() => this.open(), WAIT_MS);
      else this.cut(event.reason || "The server has stopped.");
    });
  }

  send(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }
}
