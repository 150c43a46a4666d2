// The player: reads the film, makes a pane for each showing, and draws when anything changed.

import { Camera } from "./camera.js";
import { Chart } from "./chart.js";
import { Clock } from "./clock.js";
import { listenToButtons, listenToKeys } from "./controls.js";
import { listen, listenToChart } from "./gestures.js";
import { LOOKS } from "./looks.js";
import { Pane } from "./pane.js";
import { readFilm } from "./payload.js";
import { Roads } from "./roads.js";
import { readColours, toggleTheme } from "./theme.js";
import { Tooltip } from "./tooltip.js";

const FRAMES_KEPT = 240;

class Player {
  constructor(film, page) {
    this.film = film;
    this.page = page;
    this.clock = new Clock(film);
    this.camera = new Camera();
    this.options = { trails: true, ids: false, hovered: null, pinned: null, moving: false };
    this.pinnedIn = null;
    this.roads = new Roads(film.map, LOOKS.strokes);
    this.panes = film.showings.map((showing, at) => this.makePane(showing, at));
    this.chart = new Chart(page.chart, film, this.clock);
    this.tooltip = new Tooltip(page.tooltip);
    this.drawMs = []; // How long the last frames took to draw, for benchmarks.
    this.waiting = false;
  }

  makePane(showing, at) {
    const element = this.page["pane-template"].content.firstElementChild.cloneNode(true);
    this.page.panes.append(element);
    const pane = new Pane(showing, this.film, this.roads, element);
    const rollouts = this.film.showings.filter((each) => each.name !== "log");
    const rank = rollouts.indexOf(showing);
    pane.colour = rank < 0 ? "log" : `s${rank % LOOKS.series}`;
    pane.dash = (rank + 1) % LOOKS.series;
    pane.short = showing.name.replace("rollout ", "");
    pane.key = rank < 0 ? "l" : pane.short; // Rollouts from 10 on have a chip, but no key.
    element.style.setProperty("--own", `var(--${pane.colour})`);
    element.querySelector(".name").textContent = showing.name;
    element.querySelector(".alone").addEventListener("click", () => this.showAlone(at));
    this.page.chips.append(this.makeChip(pane, at));
    return pane;
  }

  makeChip(pane, at) {
    const chip = document.createElement("button");
    chip.className = "chip";
    chip.textContent = pane.showing.name;
    chip.title = `Show or hide (${pane.key.toUpperCase()})`;
    chip.style.setProperty("--own", `var(--${pane.colour})`);
    chip.addEventListener("click", () => this.switchPane(at));
    pane.chip = chip;
    return chip;
  }

  firstShown() {
    return this.panes.find((pane) => pane.shown);
  }

  play() {
    this.clock.toggle();
    this.change();
  }

  seek(time) {
    this.clock.jump(time);
    this.change();
  }

  setSpeed(by) {
    this.clock.changeSpeed(by);
  }

  toggle(option) {
    this.options[option] = !this.options[option];
  }

  follow() {
    const { camera } = this;
    if (camera.following) camera.leave(this.firstShown());
    else [camera.following, camera.followed] = [true, this.options.pinned];
  }

  switchTheme() {
    toggleTheme();
    this.repaint();
  }

  help() {
    const { help_overlay: overlay } = this.page;
    if (overlay.open) overlay.close();
    else overlay.showModal();
  }

  /** Show or hide one showing; one always stays. */
  switchPane(at) {
    const others = this.panes.some((pane, each) => each !== at && pane.shown);
    if (others) this.panes[at].element.hidden = this.panes[at].shown;
    this.arrange();
  }

  /** Show one showing alone, or all again. */
  showAlone(at) {
    const alone = this.panes.every((pane, each) => pane.shown === (each === at));
    this.panes.forEach((pane, each) => {
      pane.element.hidden = !alone && each !== at;
    });
    this.arrange();
  }

  hover(pane, id) {
    this.options.hovered = id === null ? null : { pane, id };
    if (pane) pane.canvas.style.cursor = id === null ? "" : "pointer";
    this.change();
  }

  /** Keep an agent chosen; in every pane the one of the same id is. */
  pin(id, pane) {
    this.options.pinned = id === this.options.pinned ? null : id;
    this.pinnedIn = this.options.pinned === null ? null : pane;
    if (this.camera.following) this.camera.followed = this.options.pinned;
    this.change();
  }

  /** Give the panes their room: as square as the page allows. */
  arrange() {
    const shown = this.panes.filter((pane) => pane.shown);
    const { clientWidth, clientHeight } = this.page.panes;
    const columns = bestColumns(shown.length, clientWidth, clientHeight);
    const rows = Math.ceil(shown.length / columns);
    this.page.panes.style.gridTemplateColumns = tracks(clientWidth, columns);
    this.page.panes.style.gridTemplateRows = tracks(clientHeight, rows);
    shown.forEach((pane, at) => {
      const left = at === shown.length - 1 ? columns * rows - shown.length : 0;
      pane.element.style.gridColumn = `span ${1 + left}`; // No room stays empty.
    });
    this.panes.forEach((pane) => pane.chip.setAttribute("aria-pressed", pane.shown));
    this.chart.element.style.setProperty("--rows", shown.length);
    this.repaint();
  }

  /** Draw everything anew: sizes or colours are others now. */
  repaint() {
    this.colours = readColours(LOOKS.colours);
    this.panes.forEach((pane) => pane.picture.forget());
    this.chart.draw(this.panes, this.colours);
    this.change();
  }

  /** Ask for a frame. */
  change() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame((ms) => {
      this.waiting = false;
      this.frame(ms);
    });
  }

  frame(ms) {
    const began = performance.now();
    this.clock.advance(ms);
    this.options.moving = this.clock.playing;
    let due = false;
    for (const pane of this.panes) {
      if (!pane.shown) continue;
      pane.fit();
      pane.look(this.camera, this.clock.step);
      due = pane.draw(this.clock.step, this.options, this.colours, ms) || due;
    }
    this.chart.movePlayhead(this.clock.time);
    this.tell();
    this.drawMs.push(performance.now() - began);
    if (this.drawMs.length > FRAMES_KEPT) this.drawMs.shift();
    if (this.clock.playing || due) this.change();
  }

  /** Bring words and buttons up to date. */
  tell() {
    const { clock, page, options, camera } = this;
    page.time.textContent = `${clock.time.toFixed(1)} s`;
    page.scrub.value = clock.time;
    page.play.setAttribute("aria-pressed", clock.playing);
    page.play.setAttribute("aria-label", clock.playing ? "Pause" : "Play");
    page.speed.value = clock.speed;
    page.follow.setAttribute("aria-pressed", camera.following);
    page.trails.setAttribute("aria-pressed", options.trails);
    page.ids.setAttribute("aria-pressed", options.ids);
    const { pane, id } = options.hovered ?? { pane: this.pinnedIn, id: options.pinned };
    this.tooltip.show(pane?.shown ? pane : null, id, clock);
  }
}

/** Columns that make the panes largest: their shorter sides decide. */
function bestColumns(count, width, height) {
  let [best, most] = [1, 0];
  for (let columns = 1; columns <= count; columns++) {
    const side = Math.min(width / columns, height / Math.ceil(count / columns));
    if (side > most) [best, most] = [columns, side];
  }
  return best;
}

/** Widths of so many parts with a pixel between, on whole pixels: or pictures would blur. */
function tracks(total, count) {
  const density = devicePixelRatio || 1;
  const edge = (at) => Math.round((at * (total + 1) * density) / count) / density;
  const widths = Array.from({ length: count }, (_, at) => edge(at + 1) - edge(at) - 1);
  return widths.map((width) => `${width}px`).join(" ");
}

/** Elements with an id, by that id. */
function findPage() {
  const named = [...document.querySelectorAll("[id]")].map((each) => [each.id, each]);
  return Object.fromEntries(named);
}

/** Start where the address says: `#t=12.5`. */
function startTime() {
  const found = /(?:^#|&)t=(-?[\d.]+)/.exec(location.hash);
  return found ? Number(found[1]) : null;
}

async function start() {
  const page = findPage();
  const film = await readFilm(page.payload.textContent);
  const player = new Player(film, page);
  globalThis.player = player; // For tests, and for whoever opens the console.
  [page.scrub.min, page.scrub.max] = [player.clock.start, player.clock.end];
  player.panes.forEach((pane) => listen(pane, player));
  listenToChart(player.chart, player);
  listenToButtons(player, page);
  listenToKeys(player);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => player.repaint());
  new ResizeObserver(() => player.arrange()).observe(page.panes);
  player.seek(startTime() ?? 0);
  player.arrange();
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  if (startTime() === null && !calm) player.play();
  document.documentElement.dataset.ready = "";
}

start().catch((error) => {
  document.querySelector("#failure").textContent = `This page cannot be shown: ${error.message}`;
  throw error;
});
