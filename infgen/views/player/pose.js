// Where an agent is at any time: between two steps it goes straight.

import { LOOKS } from "./looks.js";

const { agents } = LOOKS;

/**
 * Pose of an agent at a time in steps; null where it is not to be seen.
 * `alpha` falls while it is about to leave, `ghost` says that it has left just now.
 */
export function poseAt(showing, row, time) {
  const { steps, there, first, last } = showing;
  const step = Math.min(Math.floor(time), steps - 1);
  const cell = row * steps + step;
  const left = last[row] < steps;
  if (step < 0) return null;
  if (there[cell]) {
    const share = step + 1 < steps && there[cell + 1] ? time - step : 0;
    const pose = between(showing, cell, share);
    pose.alpha = left ? fade(last[row] - time) : 1;
    if (first[row] > 0) pose.alpha *= arrival(time - first[row]);
    return pose;
  }
  const since = time - last[row];
  if (!left || since < 0 || since > agents.ghostSteps) return null;
  const pose = between(showing, row * steps + last[row], 0);
  pose.alpha = agents.leavingAlpha * (1 - since / agents.ghostSteps);
  pose.ghost = true;
  return pose;
}

/** Last known pose at or before a time, for cameras that must look somewhere. */
export function lastPoseAt(showing, row, time) {
  const { steps, there } = showing;
  const step = Math.min(Math.floor(time), steps - 1);
  for (let at = step; at >= 0; at--) {
    const cell = row * steps + at;
    if (!there[cell]) continue;
    const share = at === step && at + 1 < steps && there[cell + 1] ? time - at : 0;
    return between(showing, cell, Math.min(share, 1));
  }
  return between(showing, row * steps + Math.min(showing.first[row], steps - 1), 0);
}

/** Speed in m/s, over the step that the time is in. */
export function speedAt(showing, row, time, stepS) {
  const { steps, there, x, y } = showing;
  const step = Math.min(Math.floor(time), steps - 2);
  const cell = row * steps + step;
  const from = there[cell] && there[cell + 1] ? cell : cell - 1;
  if (step < 0 || !there[from] || !there[from + 1]) return NaN;
  return Math.hypot(x[from + 1] - x[from], y[from + 1] - y[from]) / stepS;
}

function between(showing, cell, share) {
  const { x, y, heading } = showing;
  const mix = (values) => {
    const value = values[cell];
    return share ? value + share * (values[cell + 1] - value) : value;
  };
  return { x: mix(x), y: mix(y), heading: mix(heading), alpha: 1, ghost: false };
}

function fade(stepsLeft) {
  const share = Math.min(1, Math.max(0, stepsLeft / agents.fadeSteps));
  return agents.leavingAlpha + (1 - agents.leavingAlpha) * share;
}

function arrival(since) {
  return Math.min(1, agents.arriveAlpha + since / agents.arriveSteps);
}
