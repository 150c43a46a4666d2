// Playing time, in seconds from now; the history is before 0.

export const SPEEDS = [0.25, 0.5, 1, 2, 4];
const LONGEST_FRAME_S = 0.1; // A tab that slept does not jump ahead.

export class Clock {
  constructor(film) {
    this.film = film;
    this.start = -film.now * film.stepS;
    const steps = Math.max(...film.showings.map((showing) => showing.steps));
    this.end = (steps - 1 - film.now) * film.stepS;
    this.time = 0;
    this.speed = 1;
    this.playing = false;
    this.lastMs = null;
  }

  /** Time in steps of the log. */
  get step() {
    return this.film.now + this.time / this.film.stepS;
  }

  toggle() {
    if (!this.playing && this.time >= this.end) this.time = 0;
    this.playing = !this.playing;
    this.lastMs = null;
  }

  jump(time) {
    this.time = Math.min(this.end, Math.max(this.start, time));
  }

  changeSpeed(by) {
    const at = SPEEDS.indexOf(this.speed) + by;
    this.speed = SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, at))];
  }

  /** Go on to the moment of a frame. */
  advance(ms) {
    if (!this.playing) return;
    const passed = this.lastMs === null ? 0 : (ms - this.lastMs) / 1000;
    this.lastMs = ms;
    this.jump(this.time + Math.min(LONGEST_FRAME_S, passed) * this.speed);
    if (this.time >= this.end) this.playing = false;
  }
}
