// Traffic lights: red is a bar, yellow a diamond, green a disc, unknown a ring, so that the
// shape says it too.

import { LOOKS } from "./looks.js";

const COLOURS = ["stop", "go", "caution", "unknown"];
const [STOP, GO, CAUTION, NO_SIGNAL] = [0, 1, 2, 4];

/** Draw all lights. Once the log is over they stay as they were last, and pale unless `held`. */
export function drawLights(context, view, lights, time, colours) {
  if (!lights.steps) return;
  const step = Math.min(Math.max(0, Math.floor(time)), lights.steps - 1);
  const { sizeM, leastPx } = LOOKS.lights;
  const size = Math.max(sizeM, (leastPx * view.density) / view.scale);
  for (let light = 0; light < lights.x.length; light++) {
    const state = lights.state[light * lights.steps + step];
    if (state === NO_SIGNAL) continue;
    enter(context, view, lights, light);
    const over = time > lights.steps - 1 && !lights.held;
    context.globalAlpha = over ? LOOKS.lights.heldAlpha : 1;
    drawLight(context, state, size, colours);
  }
  context.globalAlpha = 1;
}

function enter(context, view, lights, light) {
  const cos = Math.cos(lights.heading[light]) * view.scale;
  const sin = Math.sin(lights.heading[light]) * view.scale;
  const x = view.width / 2 + (lights.x[light] - view.x) * view.scale;
  const y = view.height / 2 - (lights.y[light] - view.y) * view.scale;
  context.setTransform(cos, -sin, -sin, -cos, x, y);
}

function drawLight(context, state, size, colours) {
  const { barHalf, barThick, diamond, ring } = LOOKS.lights;
  context.beginPath();
  if (state === STOP) addBar(context, size * barThick, size * barHalf);
  else if (state === CAUTION) {
    const tip = diamond * size;
    for (const [x, y] of [[tip, 0], [0, tip], [-tip, 0], [0, -tip]]) context.lineTo(x, y);
    context.closePath();
  } else context.arc(0, 0, size, 0, 2 * Math.PI);
  context.fillStyle = context.strokeStyle = colours[COLOURS[state]];
  context.lineWidth = size * ring;
  if (state === STOP || state === GO || state === CAUTION) context.fill();
  else context.stroke();
}

function addBar(context, thick, half) {
  context.rect(-thick / 2, -half, thick, 2 * half);
}
