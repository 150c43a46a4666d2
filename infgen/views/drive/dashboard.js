// What the driver reads: speed, gear, who drives, traffic, and how fast the world is.

const KMH = 3.6;
const NOTE_MS = 9000;

export class Dashboard {
  constructor(page) {
    this.page = page;
    this.noteEnds = 0;
  }

  showSpeed(speed, steer) {
    this.write("speed", Math.abs(speed * KMH).toFixed(0));
    this.page.steering.style.transform = `rotate(${(-steer * 3).toFixed(3)}rad)`;
  }

  showState(state) {
    const { page } = this;
    this.write("gear", state.reverse ? "R" : "D");
    this.write("driver", state.wheel ? "you drive" : "the network drives");
    this.write("hand", state.wheel ? "hand back" : "take over");
    this.write("agents", state.agents);
    this.write("inserted", `+${state.inserted}`);
    this.write("removed", `\u2212${state.removed}`);
    this.write("time", clock(state.seconds));
    this.write("steps", `${state.p50.toFixed(0)} / ${state.p99.toFixed(0)} ms`);
    this.write("late", state.late ? `waited ${(state.late * 0.025).toFixed(1)} s` : "");
    const full = state.recorded + 1 < state.seconds;
    this.write("recorded", full ? `the first ${clock(state.recorded)} are kept` : "");
    page.pause.setAttribute("aria-pressed", state.paused);
    page.hand.setAttribute("aria-pressed", state.wheel);
    page.shift.setAttribute("aria-pressed", state.reverse);
    page.stopped.hidden = !state.paused;
  }

  /** Fill the list of scenes, once, and say which is driven. */
  showScene(message, id) {
    const { scenes, seed } = this.page;
    if (scenes.options.length !== message.scenes.length) {
      scenes.replaceChildren(...message.scenes.map((name, at) => new Option(name, at)));
    }
    scenes.value = message.number;
    seed.value = message.seed;
    this.write("scene", id);
    this.write("simulates", message.simulates);
    this.write("rules", message.rules);
  }

  note(text, bad = false) {
    this.write("note", text);
    this.page.note.classList.toggle("bad", bad);
    this.noteEnds = performance.now() + NOTE_MS;
  }

  /** Take a note away once it was there long enough. */
  tick(nowMs) {
    if (!this.noteEnds || nowMs < this.noteEnds) return;
    this.noteEnds = 0;
    this.write("note", "");
  }

  /** Write words, where they are others than before. */
  write(name, value) {
    const text = String(value);
    if (this.page[name].textContent !== text) this.page[name].textContent = text;
  }
}

function clock(seconds) {
  const whole = Math.floor(seconds);
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}
