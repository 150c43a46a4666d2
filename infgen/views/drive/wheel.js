// Keys and gamepad to what the driver holds down.

const KEYS = {
  arrowup: "throttle",
  w: "throttle",
  arrowdown: "brake",
  s: "brake",
  " ": "brake",
  arrowleft: "left",
  a: "left",
  arrowright: "right",
  d: "right",
};
const DEAD = 0.08; // A stick at rest is never quite at zero.
const LEAST_CHANGE = 0.02;
const LEAST_MS = 25;
const [BRAKE_BUTTON, THROTTLE_BUTTON, SHIFT_BUTTON] = [6, 7, 2];

export class Wheel {
  /**
   * @param {(controls: Object) => void} turn called when what is held has changed
   * @param {() => void} shift called when the gamepad's gear button is pressed
   */
  constructor(turn, shift) {
    [this.turn, this.shift] = [turn, shift];
    this.held = new Set();
    this.pad = { throttle: 0, brake: 0, steer: 0 };
    this.said = { throttle: 0, brake: 0, steer: 0 };
    [this.saidAt, this.shifting] = [-Infinity, false];
  }

  /** Take a key down or up; true if it is one of the driver's. */
  key(event, down) {
    const control = KEYS[event.key.toLowerCase()];
    if (!control) return false;
    if (down) this.held.add(event.key.toLowerCase());
    else this.held.delete(event.key.toLowerCase());
    this.say(performance.now(), true);
    return true;
  }

  release() {
    this.held.clear();
    this.say(performance.now(), true);
  }

  get controls() {
    const keys = new Set([...this.held].map((key) => KEYS[key]));
    const steer = (keys.has("left") ? 1 : 0) - (keys.has("right") ? 1 : 0);
    return {
      throttle: keys.has("throttle") ? 1 : this.pad.throttle,
      brake: keys.has("brake") ? 1 : this.pad.brake,
      steer: steer || this.pad.steer,
    };
  }

  /** Look at the gamepad, if there is one. */
  poll(nowMs) {
    const pad = [...navigator.getGamepads()].find((each) => each?.mapping === "standard");
    if (!pad) return;
    const [steer] = pad.axes;
    this.pad = {
      throttle: pad.buttons[THROTTLE_BUTTON].value,
      brake: pad.buttons[BRAKE_BUTTON].value,
      steer: Math.abs(steer) < DEAD ? 0 : -steer,
    };
    const shifting = pad.buttons[SHIFT_BUTTON].pressed;
    if (shifting && !this.shifting) this.shift();
    this.shifting = shifting;
    this.say(nowMs, false);
  }

  say(nowMs, atOnce) {
    const { controls, said } = this;
    const far = Object.keys(said).some((name) => {
      return Math.abs(controls[name] - said[name]) > LEAST_CHANGE;
    });
    if (!far || (!atOnce && nowMs - this.saidAt < LEAST_MS)) return;
    [this.said, this.saidAt] = [controls, nowMs];
    this.turn(controls);
  }

  /** Say again what is held: the server has begun another drive. */
  repeat() {
    const held = Object.values(this.controls).some((value) => value);
    if (held) this.turn(this.controls);
  }
}
