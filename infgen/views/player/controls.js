// Buttons and keys. Every key has its line in the help.

import { SPEEDS } from "./clock.js";

const PAN_PX = 60;

/** Keys as people press them, and what they do to the player. */
function keysOf(player) {
  const { clock, camera } = player;
  const step = player.film.stepS;
  const pan = (dx, dy) => camera.panBy(dx, dy, player.firstShown());
  return {
    " ": () => player.play(),
    k: () => player.play(),
    ArrowLeft: (event) => player.seek(clock.time - (event.shiftKey ? 1 : step)),
    ArrowRight: (event) => player.seek(clock.time + (event.shiftKey ? 1 : step)),
    Home: () => player.seek(clock.start),
    n: () => player.seek(0),
    End: () => player.seek(clock.end),
    "<": () => player.setSpeed(-1),
    ",": () => player.setSpeed(-1),
    ">": () => player.setSpeed(1),
    ".": () => player.setSpeed(1),
    "+": () => camera.zoomBy(1.25, player.firstShown()),
    "=": () => camera.zoomBy(1.25, player.firstShown()),
    "-": () => camera.zoomBy(0.8, player.firstShown()),
    w: () => pan(0, PAN_PX),
    a: () => pan(PAN_PX, 0),
    s: () => pan(0, -PAN_PX),
    d: () => pan(-PAN_PX, 0),
    f: () => player.follow(),
    r: () => camera.reset(),
    t: () => player.toggle("trails"),
    i: () => player.toggle("ids"),
    x: () => player.switchTheme(),
    "?": () => player.help(),
    h: () => player.help(),
    Escape: () => player.pin(null, null),
  };
}

/** Listen to the keyboard; a key that is used here does nothing else. */
export function listenToKeys(player) {
  const keys = keysOf(player);
  player.panes.forEach((pane, at) => {
    keys[pane.key] ??= () => player.switchPane(at);
  });
  addEventListener("keydown", (event) => {
    const wanted = event.ctrlKey || event.metaKey || event.altKey;
    const typing = event.target.closest?.("input, select, dialog[open]");
    const act = keys[event.key] ?? keys[event.key.toLowerCase()];
    if (wanted || typing || !act) return;
    // A focused button would be pressed by the space bar as well.
    event.preventDefault();
    act(event);
    player.change();
  });
}

/** Wire the buttons of the page. */
export function listenToButtons(player, page) {
  const on = (id, act) => page[id].addEventListener("click", () => (act(), player.change()));
  on("play", () => player.play());
  on("back", () => player.seek(player.clock.time - player.film.stepS));
  on("ahead", () => player.seek(player.clock.time + player.film.stepS));
  on("follow", () => player.follow());
  on("trails", () => player.toggle("trails"));
  on("ids", () => player.toggle("ids"));
  on("zoom-in", () => player.camera.zoomBy(1.25, player.firstShown()));
  on("zoom-out", () => player.camera.zoomBy(0.8, player.firstShown()));
  on("theme", () => player.switchTheme());
  on("help", () => player.help());
  page.speed.append(...SPEEDS.map((speed) => new Option(`${speed}x`, speed)));
  page.speed.addEventListener("change", () => {
    player.clock.speed = Number(page.speed.value);
    page.speed.blur(); // Keys belong to the player again.
  });
  page.scrub.addEventListener("input", () => player.seek(Number(page.scrub.value)));
}
