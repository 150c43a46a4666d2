// The map, drawn once to a picture that is larger than the view, and moved from then on.

import { LOOKS } from "./looks.js";

const MARGIN = 0.3; // Of the view, on every side.
const REDRAW_MS = 90; // While zooming, the old picture is stretched so long.
const STOP_SIGN = 14;

/** Lines of one stroke as a path in metres, built when first drawn. */
function buildPath(map, stroke) {
  const path = new Path2D();
  for (let line = 0; line < map.look.length; line++) {
    if (!stroke.looks.includes(map.look[line])) continue;
    if (map.bridge[line] && !stroke.bridges) continue;
    addLine(path, map, line);
    if (!stroke.widthM) path.closePath();
  }
  return path;
}

function addLine(path, map, line) {
  const [from, to] = [map.offsets[line], map.offsets[line + 1]];
  for (let at = from; at < to; at++) {
    if (at === from) path.moveTo(map.x[at], map.y[at]);
    else path.lineTo(map.x[at], map.y[at]);
  }
}

export class Roads {
  constructor(map, strokes) {
    this.map = map;
    this.strokes = strokes.map((stroke) => ({ ...stroke, path: buildPath(map, stroke) }));
    this.signs = [];
    for (let line = 0; line < map.look.length; line++) {
      if (map.look[line] === STOP_SIGN) this.signs.push(map.offsets[line]);
    }
  }

  /** Draw all of it; the context's units are metres, `scale` its pixels per metre. */
  draw(context, scale, colours) {
    context.lineCap = "butt";
    context.lineJoin = "round";
    for (const stroke of this.strokes) {
      if (!stroke.widthM) {
        context.fillStyle = colours[stroke.colour];
        context.fill(stroke.path);
        continue;
      }
      context.lineCap = stroke.widthM > 1 ? "round" : "butt";
      context.setLineDash(stroke.dashM);
      context.strokeStyle = colours[stroke.colour];
      context.lineWidth = Math.max(stroke.widthM, stroke.leastPx / scale);
      context.stroke(stroke.path);
    }
    context.setLineDash([]);
    this.drawSigns(context, scale, colours);
  }

  drawSigns(context, scale, colours) {
    const radius = Math.max(LOOKS.signM, LOOKS.signLeastPx / scale);
    context.fillStyle = colours.sign;
    context.strokeStyle = colours.white;
    context.lineWidth = radius * 0.28;
    for (const at of this.signs) {
      context.beginPath();
      for (let corner = 0; corner < 8; corner++) {
        const angle = ((corner + 0.5) * Math.PI) / 4;
        const [x, y] = [Math.cos(angle), Math.sin(angle)];
        context.lineTo(this.map.x[at] + radius * x, this.map.y[at] + radius * y);
      }
      context.closePath();
      context.fill();
      context.stroke();
    }
  }
}

/** The same view, moved by less than a pixel so that pictures fall on whole ones. */
export function onPixels(view) {
  const whole = (metres) => Math.round(metres * view.scale) / view.scale;
  return { ...view, x: whole(view.x), y: whole(view.y) };
}

/** A picture of the roads around one view. */
export class RoadPicture {
  constructor(roads) {
    this.roads = roads;
    this.canvas = document.createElement("canvas");
    this.shown = null;
    this.zoomedAt = 0;
  }

  forget() {
    this.shown = null;
  }

  /**
   * Draw the roads into a view: x, y in its middle, scale, width and height in pixels.
   * Returns whether a sharper picture is due soon.
   */
  draw(context, view, colours, time) {
    if (!this.shown || !this.covers(view)) this.render(view, colours);
    else if (this.shown.scale !== view.scale) {
      if (view.scale !== this.asked) [this.asked, this.zoomedAt] = [view.scale, time];
      if (time - this.zoomedAt > REDRAW_MS) this.render(view, colours);
    }
    const ratio = view.scale / this.shown.scale;
    const [width, height] = [this.canvas.width * ratio, this.canvas.height * ratio];
    const left = (view.width - width) / 2 + (this.shown.x - view.x) * view.scale;
    const top = (view.height - height) / 2 - (this.shown.y - view.y) * view.scale;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.drawImage(this.canvas, left, top, width, height);
    return ratio !== 1;
  }

  covers(view) {
    const { x, y, scale } = this.shown;
    const reachX = this.canvas.width / 2 / scale - view.width / 2 / view.scale;
    const reachY = this.canvas.height / 2 / scale - view.height / 2 / view.scale;
    const ratio = view.scale / scale;
    return Math.abs(view.x - x) <= reachX && Math.abs(view.y - y) <= reachY && ratio < 3;
  }

  render(view, colours) {
    const width = view.width + 2 * Math.ceil(view.width * MARGIN);
    const height = view.height + 2 * Math.ceil(view.height * MARGIN);
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    const context = this.canvas.getContext("2d", { alpha: false });
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = colours.ground;
    context.fillRect(0, 0, width, height);
    const { x, y, scale } = onPixels(view);
    context.setTransform(scale, 0, 0, -scale, width / 2 - x * scale, height / 2 + y * scale);
    this.roads.draw(context, scale, colours);
    this.shown = { x, y, scale };
  }
}
