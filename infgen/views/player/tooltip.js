// What is known of the agent under the pointer, or of the one that is pinned.

import { kindOf } from "./pane.js";
import { speedAt } from "./pose.js";

const GAP_PX = 14;

/** Lines of [name, value] about an agent. */
export function describe(pane, id, clock) {
  const { showing, film } = pane;
  const row = pane.rows.get(id);
  const speed = speedAt(showing, row, clock.step, film.stepS);
  const fast = Number.isNaN(speed) ? "unknown" : inWords(speed);
  const age = Math.max(0, clock.step - showing.first[row]) * film.stepS;
  const lines = [
    ["speed", fast],
    ["age", `${age.toFixed(1)} s`],
    ["came", cameHow(showing, row, film)],
    ["size", `${showing.length[row].toFixed(1)} x ${showing.width[row].toFixed(1)} m`],
  ];
  if (showing.last[row] < showing.steps) {
    lines.push(["leaves", `at ${seconds(showing.last[row], film)}`]);
  }
  return { title: `${kindOf(showing, row)} ${id}`, lines };
}

function inWords(speed) {
  return `${speed.toFixed(1)} m/s (${(speed * 3.6).toFixed(0)} km/h)`;
}

function cameHow(showing, row, film) {
  if (row === showing.ego) return "ego";
  if (showing.role[row] === 1) return "there at the start";
  const how = showing.name === "log" ? "seen from" : "inserted at";
  return `${how} ${seconds(showing.first[row], film)}`;
}

function seconds(step, film) {
  return `${((step - film.now) * film.stepS).toFixed(1)} s`;
}

export class Tooltip {
  constructor(element) {
    this.element = element;
  }

  /** Show an agent of a pane beside where it is now; without one, show nothing. */
  show(pane, id, clock) {
    const place = pane && id !== null ? pane.placeOf(id) : null;
    this.element.hidden = !place;
    if (!place) return;
    const { title, lines } = describe(pane, id, clock);
    const words = [element("strong", title)];
    for (const [name, value] of lines) words.push(element("span", name), element("b", value));
    this.element.replaceChildren(...words);
    this.put(pane.canvas.getBoundingClientRect(), place);
  }

  put(frame, place) {
    const { offsetWidth, offsetHeight } = this.element;
    const right = frame.left + place.x + GAP_PX;
    const left = right + offsetWidth > innerWidth ? right - 2 * GAP_PX - offsetWidth : right;
    const top = Math.min(frame.top + place.y + GAP_PX, innerHeight - offsetHeight - 4);
    const x = Math.max(4, Math.round(left));
    this.element.style.transform = `translate(${x}px, ${Math.round(top)}px)`;
  }
}

function element(tag, words) {
  const made = document.createElement(tag);
  made.textContent = words; // Never as markup: ids come from records.
  return made;
}
