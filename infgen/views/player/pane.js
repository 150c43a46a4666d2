// One showing in its frame: roads, lights, trails, agents, and who is under the pointer.

import { KINDS, buildShapes, drawAgents, drawChosen, drawPings, drawTrails } from "./agents.js";
import { drawLights } from "./lights.js";
import { lastPoseAt, poseAt } from "./pose.js";
import { RoadPicture, onPixels } from "./roads.js";

const MOST_DENSITY = 2;
const NEAR_PX = 12; // So close to an agent means the agent.
const SCALE_BAR_PX = 90;

export class Pane {
  constructor(showing, film, roads, element) {
    this.showing = showing;
    this.film = film;
    this.element = element;
    this.canvas = element.querySelector("canvas");
    this.context = this.canvas.getContext("2d", { alpha: false });
    this.words = element.querySelector(".count");
    this.flow = element.querySelector(".flow");
    this.over = element.querySelector(".over");
    this.bar = element.querySelector(".bar");
    this.picture = new RoadPicture(roads);
    // A showing that grows while it is shown keeps these itself.
    this.shapes = showing.shapes ?? buildShapes(showing);
    this.rows = showing.rows ?? new Map(Array.from(showing.id, (id, row) => [id, row]));
    this.poses = [];
    this.centre = { x: 0, y: 0 };
    this.said = "";
  }

  get shown() {
    return !this.element.hidden;
  }

  /** Take the size that the page gives; true if it is another than before. */
  fit() {
    const { clientWidth, clientHeight } = this.canvas;
    this.density = Math.min(MOST_DENSITY, devicePixelRatio || 1);
    const width = Math.round(clientWidth * this.density);
    const height = Math.round(clientHeight * this.density);
    [this.width, this.height] = [clientWidth, clientHeight];
    if (this.canvas.width === width && this.canvas.height === height) return false;
    [this.canvas.width, this.canvas.height] = [width, height];
    this.picture.forget();
    return true;
  }

  /** Where the pane looks: at whom it follows, or at the camera's own place. */
  look(camera, step) {
    const row = this.rows.get(camera.followed) ?? this.showing.ego;
    const own = { x: camera.x, y: camera.y };
    this.centre = camera.following ? lastPoseAt(this.showing, row, step) : own;
    this.scale = camera.scale(this);
  }

  /** Draw the moment; returns whether a sharper picture of the roads is due. */
  draw(step, options, colours, ms) {
    const exact = {
      x: this.centre.x,
      y: this.centre.y,
      scale: this.scale * this.density,
      width: this.canvas.width,
      height: this.canvas.height,
      density: this.density,
    };
    // Standing still all is sharp; in motion, even steps matter more.
    const view = options.moving ? exact : onPixels(exact);
    const { context, showing } = this;
    this.poses = Array.from(showing.id, (_, row) => poseAt(showing, row, step));
    const due = this.picture.draw(context, view, colours, ms);
    drawLights(context, view, this.film.lights, step, colours);
    if (options.trails) drawTrails(context, view, showing, this.poses, step, colours);
    this.drawChosen(view, options, colours);
    drawAgents(context, view, showing, this.shapes, this.poses, colours);
    drawPings(context, view, showing, this.poses, step, this.film.now, colours);
    if (options.ids) this.drawIds(view, colours);
    this.tell(step);
    return due;
  }

  drawChosen(view, options, colours) {
    const { context, showing, poses } = this;
    const hovered = options.hovered?.pane === this ? options.hovered.id : null;
    for (const id of new Set([options.pinned, hovered])) {
      const row = this.rows.get(id);
      if (row !== undefined) drawChosen(context, view, showing, row, poses[row], colours.ink);
    }
  }

  drawIds(view, colours) {
    const { context } = this;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.font = `${10.5 * view.density}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.lineWidth = 3 * view.density;
    context.strokeStyle = colours.ground;
    context.fillStyle = colours.ink;
    this.poses.forEach((pose, row) => {
      if (!pose || pose.ghost) return;
      const x = view.width / 2 + (pose.x - view.x) * view.scale;
      const lift = (this.showing.width[row] / 2) * view.scale + 8 * view.density;
      const y = view.height / 2 - (pose.y - view.y) * view.scale - lift;
      context.strokeText(this.showing.id[row], x, y);
      context.fillText(this.showing.id[row], x, y);
    });
  }

  /** Say how many are there, and that the log is over; only where it changes. */
  tell(step) {
    const at = Math.min(Math.floor(step), this.showing.steps - 1);
    const over = step > this.showing.steps - 1;
    const sizeM = niceLength(SCALE_BAR_PX / this.scale);
    const said = `${at} ${over} ${sizeM} ${this.scale}`;
    if (said === this.said) return;
    this.said = said;
    this.words.textContent = this.showing.present[at];
    this.flow.textContent = `+${this.showing.entered[at]} \u2212${this.showing.left[at]}`;
    this.over.hidden = !over;
    this.element.classList.toggle("ended", over);
    this.bar.style.width = `${sizeM * this.scale}px`;
    this.bar.textContent = `${sizeM} m`;
  }

  /** Id of the agent at a place of the pane, if there is one. */
  find(place) {
    const x = this.centre.x + (place.x - this.width / 2) / this.scale;
    const y = this.centre.y - (place.y - this.height / 2) / this.scale;
    let [nearest, found] = [Infinity, null];
    this.poses.forEach((pose, row) => {
      if (!pose || pose.ghost) return;
      const away = Math.hypot(pose.x - x, pose.y - y);
      const reach = Math.max(this.showing.length[row] / 2, NEAR_PX / this.scale);
      if (away < reach && away < nearest) [nearest, found] = [away, this.showing.id[row]];
    });
    return found;
  }

  /** Where an agent is in the pane, in CSS pixels; null if it is not there. */
  placeOf(id) {
    const pose = this.poses[this.rows.get(id)];
    if (!pose) return null;
    return {
      x: this.width / 2 + (pose.x - this.centre.x) * this.scale,
      y: this.height / 2 - (pose.y - this.centre.y) * this.scale,
    };
  }
}

/** The largest of 1, 2, 5, 10, 20 ... that is no longer. */
function niceLength(longest) {
  const power = 10 ** Math.floor(Math.log10(longest));
  return [5, 2, 1].map((part) => part * power).find((length) => length <= longest);
}

/** Kind of an agent in words. */
export function kindOf(showing, row) {
  return KINDS[showing.kind[row]] ?? "agent";
}
