// Wheel, drag and pinch on the panes, and the pointer's agent.

const WHEEL_ZOOM = 0.0016;
const CLICK_PX = 5;

/** Let a pane be panned, zoomed and pointed at. */
export function listen(pane, player) {
  const pointers = new Map();
  let moved = 0;
  const { canvas } = pane;
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault(); // Or the page would scroll.
    const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 20 : 1;
    const factor = Math.exp(-event.deltaY * lines * WHEEL_ZOOM);
    player.camera.zoomBy(factor, pane, placeOf(event, canvas));
    player.change();
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, placeOf(event, canvas));
    moved = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const place = placeOf(event, canvas);
    if (pointers.has(event.pointerId)) {
      moved += drag(pane, player, pointers, event.pointerId, place);
    } else {
      player.hover(pane, pane.find(place));
    }
  });
  canvas.addEventListener("pointerup", (event) => {
    const click = moved < CLICK_PX && pointers.size === 1;
    if (click) player.pin(pane.find(placeOf(event, canvas)), pane);
    pointers.delete(event.pointerId);
  });
  canvas.addEventListener("pointercancel", (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("pointerleave", () => player.hover(null, null));
}

/** One pointer pans, two zoom as well; returns how far the pointer has moved. */
function drag(pane, player, pointers, id, place) {
  const before = pointers.get(id);
  const others = [...pointers].filter(([other]) => other !== id).map(([, where]) => where);
  const far = Math.hypot(place.x - before.x, place.y - before.y);
  if (others.length) {
    const [other] = others;
    const ratio = distance(place, other) / Math.max(1, distance(before, other));
    player.camera.zoomBy(ratio, pane, { x: (place.x + other.x) / 2, y: (place.y + other.y) / 2 });
  }
  if (!others.length || !player.camera.following) {
    const share = others.length ? 0.5 : 1; // The middle of two moves half as far as one.
    const [dx, dy] = [(place.x - before.x) * share, (place.y - before.y) * share];
    if (far > 0) player.camera.panBy(dx, dy, pane);
  }
  pointers.set(id, place);
  player.change();
  return far;
}

function distance(one, other) {
  return Math.hypot(one.x - other.x, one.y - other.y);
}

function placeOf(event, canvas) {
  const frame = canvas.getBoundingClientRect();
  return { x: event.clientX - frame.left, y: event.clientY - frame.top };
}

/** Let the strip be clicked and dragged. */
export function listenToChart(chart, player) {
  const { canvas } = chart;
  const seek = (event) => player.seek(chart.timeAt(placeOf(event, canvas).x));
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    seek(event);
  });
  canvas.addEventListener("pointermove", (event) => event.buttons && seek(event));
}
