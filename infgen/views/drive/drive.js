// The page of `infgen drive`: the player's pane, fed by the server half a second at a time.

import { Camera } from "./camera.js";
import { Dashboard } from "./dashboard.js";
import { Driven } from "./driven.js";
import { listen } from "./gestures.js";
import { Line } from "./line.js";
import { LiveShowing } from "./live.js";
import { LOOKS } from "./looks.js";
import { Pane } from "./pane.js";
import { readFilm } from "./payload.js";
import { Roads } from "./roads.js";
import { readColours, toggleTheme } from "./theme.js";
import { Tooltip } from "./tooltip.js";
import { Wheel } from "./wheel.js";

class DrivePage {
  constructor(page) {
    this.page = page;
    this.camera = new Camera();
    this.options = { trails: true, ids: false, hovered: null, pinned: null, moving: true };
    this.dashboard = new Dashboard(page);
    this.tooltip = new Tooltip(page.tooltip);
    this.state = { paused: false, wheel: false };
    this.clock = { step: 0 };
    this.colours = readColours(LOOKS.colours);
    this.wheel = new Wheel(
      (controls) => this.line.send({ type: "control", ...controls }),
      () => this.press("shift"),
    );
    this.line = new Line(this.hearing(), (text) => this.dashboard.note(text, true));
  }

  /** What to do with each type of message. A scene takes a moment to read; others wait. */
  hearing() {
    let ready = Promise.resolve();
    const later = (act) => (message) => {
      const heardMs = performance.now();
      ready = ready.then(() => act(message, heardMs));
    };
    return {
      scene: later((message) => this.begin(message)),
      frame: later((message) => this.takeFrame(message)),
      ego: later((message, heardMs) => this.takeEgo(message, heardMs)),
      state: later((message) => this.takeState(message)),
      saved: (message) => this.dashboard.note(`saved ${message.text}`),
      error: (message) => this.dashboard.note(message.text, true),
      loading: (message) => this.dashboard.note(message.text),
    };
  }

  async begin(message) {
    const film = await readFilm(message.payload);
    film.lights.held = true; // The network sees them so for as long as one drives.
    [this.message, this.sceneNow] = [message, film.now];
    this.live = new LiveShowing(film.showings[0], film.now);
    film.showings = [this.live];
    this.film = film;
    this.driven = new Driven();
    [this.options.hovered, this.options.pinned] = [null, null];
    const element = this.page.pane.cloneNode(true); // Listeners of the last scene go with it.
    this.page.pane.replaceWith(element);
    this.page.pane = element;
    this.pane = new Pane(this.live, film, new Roads(film.map, LOOKS.strokes), element);
    listen(this.pane, this);
    this.dashboard.showScene(message, film.scene);
    this.dashboard.note("");
    this.camera.reset();
    this.wheel.repeat();
    document.documentElement.dataset.ready = film.scene;
  }

  /** Take a token step: it comes a little before it is shown. */
  takeFrame(frame) {
    this.live.take(frame);
    this.film.now = this.sceneNow - this.live.offset;
  }

  takeEgo(message, heardMs) {
    this.driven.hear(message, heardMs);
    this.dashboard.showSpeed(message.speed, message.steer);
  }

  takeState(state) {
    this.state = state;
    this.dashboard.showState(state);
  }

  press(button) {
    this.line.send({ type: "press", button });
  }

  open(scene, seed) {
    this.line.send({ type: "open", scene, seed });
  }

  restart() {
    this.open(this.message.number, this.message.seed);
  }

  reseed() {
    this.open(this.message.number, (this.message.seed + 1) % 2 ** 31);
  }

  pause() {
    this.press(this.state.paused ? "resume" : "pause");
  }

  hand() {
    this.press(this.state.wheel ? "network" : "wheel");
  }

  follow() {
    const { camera } = this;
    if (camera.following) camera.leave(this.pane);
    else [camera.following, camera.followed] = [true, this.options.pinned];
  }

  toggle(option) {
    this.options[option] = !this.options[option];
  }

  switchTheme() {
    toggleTheme();
    this.repaint();
  }

  repaint() {
    this.colours = readColours(LOOKS.colours);
    this.pane?.picture.forget();
  }

  help() {
    const { help_overlay: overlay } = this.page;
    if (overlay.open) overlay.close();
    else overlay.showModal();
  }

  /** For gestures: frames are drawn all the time. */
  change() {}

  hover(pane, id) {
    this.options.hovered = id === null ? null : { pane, id };
    if (pane) pane.canvas.style.cursor = id === null ? "" : "pointer";
  }

  pin(id) {
    this.options.pinned = id === this.options.pinned ? null : id;
    if (this.camera.following) this.camera.followed = this.options.pinned;
  }

  frame(ms) {
    this.wheel.poll(ms);
    this.dashboard.tick(ms);
    if (this.pane && this.driven?.last) this.draw(ms);
  }

  draw(ms) {
    const { time, pose, rate } = this.driven.at(performance.now(), this.state.paused);
    // Without its token step the time stands still, as the server's does.
    this.clock.step = Math.min(time - this.live.offset, this.live.steps - 1);
    this.live.placeEgo(this.clock.step, pose, rate);
    this.options.moving = !this.state.paused;
    this.pane.fit();
    this.pane.look(this.camera, this.clock.step);
    this.pane.draw(this.clock.step, this.options, this.colours, ms);
    this.tell();
  }

  tell() {
    const { page, options, camera, pane } = this;
    page.follow.setAttribute("aria-pressed", camera.following);
    page.trails.setAttribute("aria-pressed", options.trails);
    page.ids.setAttribute("aria-pressed", options.ids);
    this.tooltip.show(pane, options.hovered?.id ?? options.pinned, this.clock);
  }
}

/** Keys besides those of the wheel. */
function keysOf(drive) {
  const zoom = (factor) => drive.camera.zoomBy(factor, drive.pane);
  return {
    p: () => drive.pause(),
    r: () => drive.press("shift"),
    n: () => drive.hand(),
    c: () => drive.press("save"),
    Home: () => drive.restart(),
    m: () => drive.reseed(),
    f: () => drive.follow(),
    t: () => drive.toggle("trails"),
    i: () => drive.toggle("ids"),
    x: () => drive.switchTheme(),
    "+": () => zoom(1.25),
    "=": () => zoom(1.25),
    "-": () => zoom(0.8),
    "?": () => drive.help(),
    h: () => drive.help(),
    Escape: () => drive.pin(null),
  };
}

function listenToKeys(drive) {
  const keys = keysOf(drive);
  addEventListener("keydown", (event) => {
    const other = event.ctrlKey || event.metaKey || event.altKey;
    if (other || event.target.closest?.("input, select, dialog[open]")) return;
    const act = keys[event.key] ?? keys[event.key.toLowerCase()];
    const taken = drive.wheel.key(event, true) || act;
    if (taken) event.preventDefault(); // Or the page scrolls, or presses a focused button.
    if (act && !event.repeat) act();
  });
  addEventListener("keyup", (event) => drive.wheel.key(event, false));
  addEventListener("blur", () => drive.wheel.release());
}

function listenToButtons(drive, page) {
  const on = (id, act) => page[id].addEventListener("click", () => (act(), page[id].blur()));
  on("pause", () => drive.pause());
  on("hand", () => drive.hand());
  on("shift", () => drive.press("shift"));
  on("save", () => drive.press("save"));
  on("restart", () => drive.restart());
  on("reseed", () => drive.reseed());
  on("follow", () => drive.follow());
  on("trails", () => drive.toggle("trails"));
  on("ids", () => drive.toggle("ids"));
  on("zoom-in", () => drive.camera.zoomBy(1.25, drive.pane));
  on("zoom-out", () => drive.camera.zoomBy(0.8, drive.pane));
  on("theme", () => drive.switchTheme());
  on("help", () => drive.help());
  page.scenes.addEventListener("change", () => {
    drive.open(Number(page.scenes.value), drive.message.seed);
    page.scenes.blur();
  });
  page.seed.addEventListener("change", () => {
    if (page.seed.checkValidity()) drive.open(drive.message.number, Number(page.seed.value));
    page.seed.blur();
  });
}

/** Elements with an id, by that id. */
function findPage() {
  const named = [...document.querySelectorAll("[id]")].map((each) => [each.id, each]);
  return Object.fromEntries(named);
}

const page = findPage();
const drive = new DrivePage(page);
globalThis.drive = drive; // For tests, and for whoever opens the console.
listenToKeys(drive);
listenToButtons(drive, page);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => drive.repaint());
const draw = (ms) => {
  drive.frame(ms);
  requestAnimationFrame(draw);
};
requestAnimationFrame(draw);
