// Where the ego is at any moment between two messages: the server's time goes on meanwhile,
// and the ego as it moved last.

const STEPS_PER_MS = 0.01; // Steps of 0.1 s.
const MOST_AHEAD = 1; // Steps after the last message; then it waits.
const JUMP = 2; // Steps: farther off than that the time is set anew.
const FOLLOW = 0.08; // Share of a smaller difference that is made up for by a message.

export class Driven {
  constructor() {
    this.last = null;
    this.offset = 0;
    this.shown = -Infinity;
  }

  hear(message, nowMs) {
    const raw = message.step - nowMs * STEPS_PER_MS;
    const fresh = !this.last || Math.abs(raw - this.offset) > JUMP;
    this.offset = fresh ? raw : this.offset + FOLLOW * (raw - this.offset);
    this.last = message;
  }

  /** Time in steps, pose, and rate a step. */
  at(nowMs, paused) {
    const { step, pose, rate } = this.last;
    const ahead = Math.min(this.offset + nowMs * STEPS_PER_MS - step, MOST_AHEAD);
    const time = Math.max(paused ? step : step + ahead, this.shown);
    this.shown = time;
    const [x, y, heading] = rate.map((value) => value / 10); // A step is a tenth of a second.
    const since = time - step;
    return {
      time,
      pose: { x: pose[0] + since * x, y: pose[1] + since * y, heading: pose[2] + since * heading },
      rate: { x, y, heading },
    };
  }
}
