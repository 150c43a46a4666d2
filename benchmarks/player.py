"""How smoothly the player runs in a real browser, and how large its page is.

A made scene of the promised size (128 agents, 2,000 map tokens, 30 s; log and three
rollouts side by side) is played in Chromium without a screen or a graphics card::

    python benchmarks/player.py [--showings N] [--seconds S] [--chromium PATH]

``draw`` is what the page's own code takes for a frame, ``frame`` the time from one frame to
the next, rasterising in software included: it cannot be shorter than the screen's 16.7 ms.
The last line is one JSON object; ``median_frame_ms`` is the draw of one showing.
"""

import argparse
import json
import statistics
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from infgen.clock import CLOCK
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import SignalClass
from infgen.views.player import player_page
from infgen.views.scene.drawn_map import DrawnMap, Lights, RoadLook
from infgen.views.scene.view_model import Role, Showing, ViewModel

AGENTS, ROAD_TOKENS, STEPS, NOW = 128, 2000, 311, 10
TOKEN_M, STREET_M, REACH_M = 5.0, 500.0, 140.0
CHROMIUM = "/usr/bin/chromium"
FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


def busy_film(showings: int = 4, seed: int = 0) -> ViewModel:
    """Make a scene of the promised size: winding streets, everyone turning and braking."""
    rng = np.random.default_rng(seed)
    names = ["log", *(f"rollout {at}" for at in range(showings - 1))]
    return ViewModel(
        scenario_id="busy",
        now=NOW,
        weights="none",
        drawn_map=_streets(rng),
        lights=Lights(
            xy_m=rng.uniform(-60, 60, (16, 2)).astype(np.float32),
            heading_rad=rng.uniform(-3, 3, 16).astype(np.float32),
            state=np.repeat(
                rng.choice([SignalClass.STOP, SignalClass.GO], (16, 1)), STEPS, axis=1
            ).astype(np.int8),
        ),
        showings=tuple(_crowd(name, rng) for name in names),
    )


def _streets(rng: np.random.Generator) -> DrawnMap:
    """Winding lines of all looks, as long together as so many map tokens."""
    count = round(ROAD_TOKENS * TOKEN_M / STREET_M)
    looks = np.sort(np.resize([RoadLook.LANE, RoadLook.WHITE_BROKEN, RoadLook.EDGE], count))
    along_m = np.linspace(-STREET_M / 2, STREET_M / 2, 251)
    lines = []
    for at in range(count):
        winding_m = 3 * np.sin(along_m / 9 + at) + 12 * (at - count / 2)
        line = np.column_stack([along_m, winding_m])
        lines.append(line if at % 2 else line[:, ::-1])
    return DrawnMap(
        look=looks.astype(np.int8),
        bridge=np.zeros(count, bool),
        offsets=len(along_m) * np.arange(count + 1, dtype=np.int64),
        xy_m=np.concatenate(lines).astype(np.float32),
    )


def _crowd(name: str, rng: np.random.Generator) -> Showing:
    """Agents that turn and change their speed all the time."""
    start = rng.uniform(-REACH_M, REACH_M, (AGENTS, 1, 2))
    heading = rng.uniform(-np.pi, np.pi, (AGENTS, 1)) + np.cumsum(
        rng.normal(0, 0.03, (AGENTS, STEPS)), axis=1
    )
    speed_mps = np.abs(5 + np.cumsum(rng.normal(0, 0.2, (AGENTS, STEPS)), axis=1))
    step_m = CLOCK.step_s * speed_mps[..., None]
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    xy_m = start + np.cumsum(step_m * ahead, axis=1)
    agent_type = rng.choice(
        [AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST],
        AGENTS,
        p=[0.7, 0.2, 0.1],
    )
    role = np.where(np.arange(AGENTS) % 3, Role.INITIAL, Role.INSERTED)
    role[0] = Role.EGO
    pose = np.concatenate([xy_m, heading[..., None]], axis=-1)
    return Showing(
        name=name,
        ego=0,
        id=np.arange(AGENTS, dtype=np.int32),
        agent_type=agent_type.astype(np.int8),
        role=role.astype(np.int8),
        size_lw_m=np.where(agent_type[:, None] == 0, [4.6, 2.0], [0.9, 0.8]).astype(
            np.float32
        ),
        pose=pose.astype(np.float32),
        valid=np.ones((AGENTS, STEPS), bool),
        last_step=np.full(AGENTS, STEPS, np.int16),
    )


_MEASURE = """async (seconds) => {
  const gaps = [];
  let last = null;
  player.drawMs.length = 0;
  player.play();
  await new Promise((done) => {
    const end = performance.now() + 1000 * seconds;
    const frame = (now) => {
      if (last !== null) gaps.push(now - last);
      last = now;
      if (now < end) requestAnimationFrame(frame);
      else done();
    };
    requestAnimationFrame(frame);
  });
  player.play();
  return { draw: player.drawMs, gaps };
}"""


def play(page: Path, seconds: float, chromium: str) -> dict[str, list[float]]:
    """Play a page for a while; returns milliseconds of drawing and between frames."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415

    with sync_playwright() as browsers:
        browser = browsers.chromium.launch(executable_path=chromium, args=list(FLAGS))
        shown = browser.new_page(viewport={"width": 1440, "height": 900})
        shown.goto(f"{page.as_uri()}#t=0")
        shown.wait_for_selector("html[data-ready]", state="attached")
        measured: dict[str, list[float]] = shown.evaluate(_MEASURE, seconds)
        browser.close()
    return measured


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table and the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--showings", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--seconds", type=float, default=8.0, help="of playing, each")
    parser.add_argument("--chromium", default=CHROMIUM)
    options = parser.parse_args(arguments)
    figures: dict[str, Any] = {"agents": AGENTS, "road_tokens": ROAD_TOKENS}
    print("| showings | bytes | draw ms, median | 95 % | frame ms, median | 95 % |")
    print("|---:|---:|---:|---:|---:|---:|")
    for showings in options.showings:
        text = player_page(busy_film(showings))
        with tempfile.TemporaryDirectory() as folder:
            page = Path(folder) / "busy.html"
            page.write_text(text)
            measured = play(page, options.seconds, options.chromium)
        row = [
            figure
            for values in (measured["draw"], measured["gaps"])
            for figure in (statistics.median(values), float(np.quantile(values, 0.95)))
        ]
        print(f"| {showings} | {len(text)} | " + " | ".join(f"{v:.2f}" for v in row) + " |")
        names = ("draw_ms", "draw_ms_95", "frame_ms", "frame_ms_95")
        found = dict(zip(names, (round(value, 2) for value in row), strict=True))
        figures[f"showings_{showings}"] = {**found, "file_bytes": len(text)}
    first = figures[f"showings_{options.showings[0]}"]
    last = figures[f"showings_{options.showings[-1]}"]
    figures |= {"median_frame_ms": first["draw_ms"], "file_bytes": last["file_bytes"]}
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
