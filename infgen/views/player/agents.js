// Agents as shapes: a car has a windscreen, a cyclist is an arrow, a pedestrian a disc with a
// nose. The ego wears a ring, who came in later a dot: colours alone must not tell.

import { LOOKS } from "./looks.js";

export const ROLES = ["ego", "initial", "inserted"];
export const KINDS = ["vehicle", "pedestrian", "cyclist", "other"];
const [EGO, INSERTED] = [0, 2];
const looks = LOOKS.agents;

/** Outline and marks of one agent in its own frame, in metres, x ahead. */
export function buildShape(kind, length, width) {
  const body = new Path2D();
  const mark = new Path2D();
  if (kind === 0) addCar(body, mark, length, width);
  else if (kind === 1) addWalker(body, Math.max(length, width) / 2);
  else if (kind === 2) addCyclist(body, length, width);
  else addDiamond(body, length / 2, width / 2);
  return { body, mark };
}

function addCar(body, mark, length, width) {
  const [front, rear] = [Math.min(width * looks.front, length / 3), width * looks.rear];
  // Corners from rear left on, the way roundRect goes round.
  body.roundRect(-length / 2, -width / 2, length, width, [rear, front, front, rear]);
  const base = length / 2 - Math.min(length * looks.screenBase, looks.screenBaseMostM);
  const tip = length / 2 - Math.min(length * looks.screenTip, looks.screenTipMostM);
  const [below, above] = [width * looks.screenBaseHalf, width * looks.screenTipHalf];
  addPolygon(mark, [[base, below], [tip, above], [tip, -above], [base, -below]]);
}

function addWalker(body, radius) {
  const beak = Math.PI / 4;
  body.arc(0, 0, radius, beak, -beak);
  body.lineTo(radius * looks.beak, 0);
  body.closePath();
}

function addCyclist(body, length, width) {
  const half = Math.max(width, length * 0.5) / 2;
  addPolygon(body, [[length / 2, 0], [-length / 2, half], [-length / 4, 0], [-length / 2, -half]]);
}

function addDiamond(body, reach, half) {
  addPolygon(body, [[reach, 0], [0, half], [-reach, 0], [0, -half]]);
}

function addPolygon(path, corners) {
  corners.forEach(([x, y], at) => (at ? path.lineTo(x, y) : path.moveTo(x, y)));
  path.closePath();
}

export function buildShapes(showing) {
  const { kind, length, width } = showing;
  return Array.from(kind, (each, row) => buildShape(each, length[row], width[row]));
}

/** Make the context's frame that of an agent, enlarged where it would be too small to see. */
function enter(context, view, pose, longest) {
  const scale = view.scale * Math.max(1, (looks.leastPx * view.density) / (longest * view.scale));
  const [cos, sin] = [Math.cos(pose.heading) * scale, Math.sin(pose.heading) * scale];
  const x = view.width / 2 + (pose.x - view.x) * view.scale;
  const y = view.height / 2 - (pose.y - view.y) * view.scale;
  context.setTransform(cos, -sin, -sin, -cos, x, y);
  return scale;
}

/** Make the context's frame that of the world, in metres. */
function enterWorld(context, view) {
  const left = view.width / 2 - view.x * view.scale;
  const top = view.height / 2 + view.y * view.scale;
  context.setTransform(view.scale, 0, 0, -view.scale, left, top);
}

export function drawAgents(context, view, showing, shapes, poses, colours) {
  for (let row = 0; row < poses.length; row++) {
    const pose = poses[row];
    if (!pose || !inView(view, pose)) continue;
    drawAgent(context, view, showing, shapes[row], row, pose, colours);
  }
  context.globalAlpha = 1;
}

function drawAgent(context, view, showing, shape, row, pose, colours) {
  const role = showing.role[row];
  const scale = enter(context, view, pose, Math.max(showing.length[row], showing.width[row]));
  const px = view.density / scale;
  context.globalAlpha = pose.alpha;
  if (pose.ghost) {
    context.strokeStyle = colours[ROLES[role]];
    context.lineWidth = 1.5 * px;
    context.stroke(shape.body);
    return;
  }
  if (role === EGO) drawHalo(context, showing.length[row] * looks.halo, px, colours.ego);
  context.fillStyle = colours[ROLES[role]];
  context.fill(shape.body);
  context.strokeStyle = colours.outline;
  context.lineWidth = looks.outlinePx * px;
  context.stroke(shape.body);
  context.fillStyle = colours.outline;
  context.fill(shape.mark);
  if (role === INSERTED) drawDot(context, showing, row);
}

function drawHalo(context, radius, px, colour) {
  const { globalAlpha } = context;
  drawRing(context, radius, 0.75 * px, colour);
  context.globalAlpha = looks.haloAlpha * globalAlpha;
  context.fillStyle = colour;
  context.fill();
  context.globalAlpha = globalAlpha;
}

function drawRing(context, radius, px, colour) {
  context.strokeStyle = colour;
  context.lineWidth = 2 * px;
  context.beginPath();
  context.arc(0, 0, radius, 0, 2 * Math.PI);
  context.stroke();
}

function drawDot(context, showing, row) {
  const car = showing.kind[row] === 0;
  context.beginPath();
  const place = car ? -showing.length[row] * looks.dotBack : 0;
  context.arc(place, 0, showing.width[row] * looks.dot, 0, 2 * Math.PI);
  context.fill();
}

function inView(view, pose) {
  const reach = 15 * view.scale;
  const x = Math.abs(pose.x - view.x) * view.scale;
  const y = Math.abs(pose.y - view.y) * view.scale;
  return x < view.width / 2 + reach && y < view.height / 2 + reach;
}

/** Where everyone has been, paler the longer ago. One stroke per colour and band of age. */
export function drawTrails(context, view, showing, poses, time, colours) {
  enterWorld(context, view);
  context.lineCap = "butt";
  context.lineJoin = "round";
  context.lineWidth = Math.max(looks.trailM, (looks.trailPx * view.density) / view.scale);
  const paths = ROLES.map(() => Array.from({ length: looks.trailBands }, () => new Path2D()));
  for (let row = 0; row < poses.length; row++) {
    if (!poses[row] || !inView(view, poses[row])) continue;
    addTrail(paths[showing.role[row]], showing, row, poses[row], time);
  }
  paths.forEach((bands, role) => {
    context.strokeStyle = colours[ROLES[role]];
    bands.forEach((path, band) => {
      context.globalAlpha = looks.trailAlpha * (1 - band / looks.trailBands) ** 1.5;
      context.stroke(path);
    });
  });
  context.globalAlpha = 1;
}

function addTrail(bands, showing, row, pose, time) {
  const { steps, there, x, y } = showing;
  const newest = Math.min(Math.floor(time), steps - 1);
  const oldest = Math.max(0, newest - looks.trailSteps);
  let [fromX, fromY] = [pose.x, pose.y];
  let band = null;
  for (let step = newest; step >= oldest; step--) {
    const cell = row * steps + step;
    if (!there[cell]) {
      if (step < showing.last[row]) return;
      continue;
    }
    const age = Math.floor(((newest - step) * looks.trailBands) / looks.trailSteps);
    const path = bands[Math.min(looks.trailBands - 1, age)];
    if (path !== band) path.moveTo(fromX, fromY);
    path.lineTo(x[cell], y[cell]);
    [fromX, fromY, band] = [x[cell], y[cell], path];
  }
}

/** A ring that grows and fades around whoever has just come in. */
export function drawPings(context, view, showing, poses, time, now, colours) {
  context.setTransform(1, 0, 0, 1, 0, 0);
  for (let row = 0; row < poses.length; row++) {
    const since = (time - showing.first[row]) / looks.pingSteps;
    if (!poses[row] || showing.first[row] <= now || since < 0 || since > 1) continue;
    const x = view.width / 2 + (poses[row].x - view.x) * view.scale;
    const y = view.height / 2 - (poses[row].y - view.y) * view.scale;
    context.globalAlpha = 0.8 * (1 - since);
    context.strokeStyle = colours[ROLES[showing.role[row]]];
    context.lineWidth = 2 * view.density;
    context.beginPath();
    const body = 0.6 * showing.length[row] * view.scale;
    context.arc(x, y, body + (3 + 16 * since) * view.density, 0, 2 * Math.PI);
    context.stroke();
  }
  context.globalAlpha = 1;
}

/** The whole way of one agent, and a ring around it. */
export function drawChosen(context, view, showing, row, pose, colour) {
  const { scale } = view;
  const { steps, there, x, y } = showing;
  enterWorld(context, view);
  context.beginPath();
  for (let step = 0; step < steps; step++) {
    const cell = row * steps + step;
    if (there[cell] && step && there[cell - 1]) context.lineTo(x[cell], y[cell]);
    else if (there[cell]) context.moveTo(x[cell], y[cell]);
  }
  context.strokeStyle = colour;
  context.lineWidth = (1.5 * view.density) / scale;
  context.setLineDash([(4 * view.density) / scale, (4 * view.density) / scale]);
  context.stroke();
  context.setLineDash([]);
  if (!pose) return;
  const own = enter(context, view, pose, showing.length[row]);
  const radius = showing.length[row] * 0.62 + (4 * view.density) / own;
  drawRing(context, radius, view.density / own, colour);
}
