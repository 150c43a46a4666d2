// What part of the world the panes look at. All of them share it, so that they compare.

import { LOOKS } from "./looks.js";

const [LEAST_SCALE, MOST_SCALE] = [0.4, 80];

export class Camera {
  constructor() {
    this.following = true;
    this.followed = null; // Track id; null for the ego.
    this.x = 0;
    this.y = 0;
    this.zoom = 1;
  }

  /** Pixels per metre in a pane of some size, all in CSS pixels. */
  scale(pane) {
    return Math.min(MOST_SCALE, Math.max(LEAST_SCALE, this.fit(pane) * this.zoom));
  }

  /** Pixels per metre that show what is within reach. */
  fit(pane) {
    return Math.max(1, Math.min(pane.width, pane.height)) / 2 / LOOKS.reachM;
  }

  /** Zoom in or out; a place in a pane keeps its place unless the camera follows. */
  zoomBy(factor, pane, place) {
    const before = this.scale(pane);
    this.zoom *= factor;
    const after = this.scale(pane);
    this.zoom = after / this.fit(pane); // Beyond the limits nothing shall pile up.
    if (this.following || !place) return;
    this.x += (place.x - pane.width / 2) * (1 / before - 1 / after);
    this.y -= (place.y - pane.height / 2) * (1 / before - 1 / after);
  }

  /** Move over the world; whoever moves the camera by hand no longer follows. */
  panBy(dx, dy, pane) {
    this.leave(pane);
    const scale = this.scale(pane);
    this.x -= dx / scale;
    this.y += dy / scale;
  }

  /** Stay where a pane looks now. */
  leave(pane) {
    if (!this.following) return;
    this.following = false;
    [this.x, this.y] = [pane.centre.x, pane.centre.y];
  }

  reset() {
    [this.following, this.followed, this.zoom] = [true, null, 1];
  }
}
