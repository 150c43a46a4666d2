"""Does a scene stay alive, and do inserted agents set off as real ones do?

Reads the logs and the rollouts of a root, however long they are::

    python benchmarks/traffic_drift.py ROOT [--span 10] [--radius 75]

The first table has the rollouts, span by span, beside the logs as far as they go: agents
around the ego, its speed and that of vehicles, the share of vehicles that are off the road
(most are parked there), that of those that drive, entries and exits per half second, and in
how many token steps the ego, and other vehicles, set off after standing for two seconds.
The second has by what share each of these is above the logs', and 95 % of resamples of the
scenes. The third has who comes after now, from when it is near: speed in the first second,
who begins off the road or overlaps another agent, pedestrians and cyclists; below it stands
how far apart logs and rollouts are in speeds and in the side inserted agents come from. A
rollout whose ego leaves the map, where a street out of town ends, counts until then. It is
said how many do, how long one stands at most, and by how much agents, its speed and
off-road shares drift from the first span, and from the second, to the last. The last line
is one JSON object.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from insertions import STEPS_PER_S, InsertedSample, apart_bits
from jaxtyping import Float64
from numpy.lib.stride_tricks import sliding_window_view

from infgen.clock import CLOCK
from infgen.config import TokenSettings
from infgen.metrics.intervals import Interval, bootstrap
from infgen.metrics.kinematics import speed, speed_valid
from infgen.metrics.placement import count_per_token
from infgen.metrics.road import road_edge_m
from infgen.metrics.traffic import Traffic, from_log, from_rollout, on_map
from infgen.rollout.rules.off_road import Lanes, lane_segments
from infgen.scene import AgentType
from infgen.settings import build
from infgen.spatial.road_edges import RoadEdges, scene_road_edges
from infgen.tokens.tracks import TokensError
from pipeline.commands.screen import show_table
from pipeline.engine.manifest import read_manifest
from pipeline.storage.rollouts import read_rollouts
from pipeline.storage.scene_lookup import open_scene_lookup, unit_folders

DRIVING_MPS = 1.0
"""Vehicles that are faster drive."""
STILL_M = 0.1
"""Who moves less in half a second stands ..."""
STOOD_TOKENS = 4
"""... and has stood after so many of them."""
DRIFTING = ("agents", "ego_mps", "off_road")
RESAMPLES = 2000
COLUMNS = {
    "agents": ("agents", ".1f"),
    "ego_mps": ("ego, m/s", ".2f"),
    "speed_mps": ("vehicles, m/s", ".2f"),
    "off_road": ("off-road", ".1%"),
    "driving_off_road": ("driving off-road", ".1%"),
    "entries": ("entries / 0.5 s", ".3f"),
    "exits": ("exits / 0.5 s", ".3f"),
    "ego_sets_off": ("ego sets off", ".1%"),
    "sets_off": ("others set off", ".1%"),
}


@dataclass(slots=True)
class Side:
    """Logs, or rollouts: sums and counts of each figure by span, and inserted agents."""

    sums: dict[str, Float64[np.ndarray, "2 span"]]
    inserted: InsertedSample = field(default_factory=InsertedSample)
    count: int = 0
    left_map_s: list[float] = field(default_factory=list)
    ego_stood_s: list[float] = field(default_factory=list)
    until: list[dict[str, Float64[np.ndarray, "2 span"]]] = field(default_factory=list)
    """Sums and counts after each scene."""

    def end_scene(self) -> None:
        """Note what there is: the next values are of another scene."""
        self.until.append({name: sums.copy() for name, sums in self.sums.items()})

    def scenes(self, name: str) -> Float64[np.ndarray, "scene 2 span"]:
        """Sums and counts of one figure in each scene."""
        sums = np.stack([one[name] for one in self.until])
        return np.diff(sums, axis=0, prepend=np.zeros_like(sums[:1]))

    def drift(self, name: str, first: int) -> Interval:
        """Tell by what share a figure is larger in the last span than in another."""
        each = self.scenes(name)
        ends = each[:, :, [first, -1]].reshape(len(each), 4)

        def follow(means: np.ndarray) -> np.ndarray:
            before, after, seen_before, seen_after = np.maximum(means, 1e-12).T
            return (after / seen_after / (before / seen_before) - 1)[:, None]

        return bootstrap(ends, follow, RESAMPLES, 0)

    def means(self, name: str) -> Float64[np.ndarray, " span"]:
        """Means of one figure; NaN for spans that nothing reaches."""
        total, count = self.sums[name]
        return np.where(count > 0, total / np.where(count > 0, count, 1), np.nan)

    def add(self, name: str, at_s: np.ndarray, values: np.ndarray, span_s: float) -> None:
        """Add values that belong to times after now; none beyond the last span."""
        span = (at_s / span_s + 1e-6).astype(int)
        inside = span < self.sums[name].shape[1]
        np.add.at(self.sums[name][0], span[inside], values[inside])
        np.add.at(self.sums[name][1], span[inside], 1)


def beside(logs: Side, played: Side, name: str) -> Interval:
    """Tell by what share a figure of rollouts is above the logs', span by span."""
    each = np.concatenate([logs.scenes(name), played.scenes(name)], axis=1)

    def follow(means: np.ndarray) -> np.ndarray:
        logged, seen, ours, seen_ours = means.reshape(len(means), 4, -1).swapaxes(0, 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            above: np.ndarray = ours / seen_ours / (logged / seen) - 1
        return np.where(np.isfinite(above), above, np.nan)

    return bootstrap(each.reshape(len(each), -1), follow, RESAMPLES, 0)


@dataclass(frozen=True, slots=True)
class Look:
    """How everything is looked at."""

    span_s: float
    radius_m: float


@dataclass(frozen=True, slots=True)
class Place:
    """Edges of a map's roads, and its lanes: where pieces begin, and their ways."""

    edges: RoadEdges | None
    lanes: Lanes


def take(side: Side, whole: Traffic, place: Place, look: Look) -> None:
    """Measure one log or rollout."""
    traffic, edges = on_map(whole, place.lanes), place.edges
    side.count += 1
    if traffic is not whole:
        side.left_map_s.append(len(traffic.motion.x_m[0, 0]) * CLOCK.step_s)
    motion, now = traffic.motion, traffic.now
    x_m, y_m, valid = motion.x_m[0], motion.y_m[0], motion.valid[0]
    others = np.arange(len(valid)) != traffic.ego
    away_m = np.hypot(x_m - x_m[traffic.ego], y_m - y_m[traffic.ego])
    near = valid & (away_m < look.radius_m) & others[:, None]
    vehicle = (motion.agent_type == AgentType.VEHICLE)[:, None]
    speed_mps = speed(x_m, y_m)
    known = speed_valid(valid)

    steps = np.arange(now + 1, valid.shape[1])
    at_s = (steps - now - 1) * CLOCK.step_s
    side.add("agents", at_s, near[:, steps].sum(axis=0), look.span_s)
    row, step = np.nonzero((near & vehicle & known)[:, steps])
    side.add("speed_mps", at_s[step], speed_mps[row, steps[step]], look.span_s)
    seen = known[traffic.ego, steps]
    ego_mps = speed_mps[traffic.ego, steps[seen]]
    side.add("ego_mps", at_s[seen], ego_mps, look.span_s)
    if edges is not None:
        some = slice(now + 1, None, STEPS_PER_S)
        rows = np.flatnonzero(vehicle[:, 0])
        off = road_edge_m(motion, rows, some, edges)[0] > 0
        drives = (near | ~others[:, None]) & known & (speed_mps > DRIVING_MPS)
        for name, those in (("off_road", near), ("driving_off_road", drives)):
            row, step = np.nonzero(those[rows, some])
            side.add(name, at_s[::STEPS_PER_S][step], off[row, step], look.span_s)
    _take_starts(side, traffic, near & vehicle, look)
    _take_events(side, traffic, len(steps), look)
    side.inserted.take(traffic, edges, speed_mps, known, near)


def _take_starts(side: Side, traffic: Traffic, others: np.ndarray, look: Look) -> None:
    """Look at who has stood for a while: does it set off in the next half second?"""
    motion, stride = traffic.motion, CLOCK.steps_per_token
    knots = np.arange(traffic.now % stride, motion.valid.shape[2], stride)
    x_m, y_m, valid = (
        motion.x_m[0, :, knots],
        motion.y_m[0, :, knots],
        motion.valid[0, :, knots],
    )
    seen = valid[1:] & valid[:-1]  # [half second, agent]
    way_m = np.hypot(np.diff(x_m, axis=0), np.diff(y_m, axis=0))
    still = seen & (way_m < STILL_M)
    moves = np.flatnonzero(~still[knots[:-1] >= traffic.now, traffic.ego])
    ends = np.concatenate([[-1], moves, [np.count_nonzero(knots[:-1] >= traffic.now)]])
    side.ego_stood_s.append(float((np.diff(ends).max() - 1) * CLOCK.token_s))
    if len(still) <= STOOD_TOKENS:
        return
    before = sliding_window_view(still[:-1], STOOD_TOKENS, axis=0)
    stood: np.ndarray = np.asarray(before.all(axis=-1))
    later, begins = np.arange(STOOD_TOKENS, len(still)), knots[STOOD_TOKENS:-1]
    ego = np.arange(stood.shape[1]) == traffic.ego
    for name, who in (("ego_sets_off", ego), ("sets_off", others[:, begins].T)):
        asked = stood & seen[later] & who & (begins >= traffic.now)[:, None]
        half, row = np.nonzero(asked)
        at_s = (begins[half] - traffic.now) * CLOCK.step_s
        side.add(name, at_s, ~still[later[half], row], look.span_s)


def _take_events(side: Side, traffic: Traffic, num_steps: int, look: Look) -> None:
    """Count entries and exits; nobody is seen to come or go in a log's last second."""
    events, tokens = traffic.events, num_steps // CLOCK.steps_per_token - 2
    at_s = np.arange(tokens) * CLOCK.token_s
    for name, token, distance_m in (
        ("entries", events.entry_token, events.entry_distance_m),
        ("exits", events.exit_token, events.exit_distance_m),
    ):
        found = count_per_token(token, distance_m, look.radius_m, tokens)
        side.add(name, at_s, found, look.span_s)


def measure(root: Path, look: Look) -> tuple[Side, Side]:
    """Measure the logs that have rollouts in a root, and the rollouts.

    Raises:
        FileNotFoundError: if there are none.
    """
    logs = open_scene_lookup([str((root / "latest" / "ingest").resolve())])
    tokens = _tokens_of(root / "latest" / "tokenize")
    units = unit_folders(root / "latest" / "rollout") or []
    rollouts = (one for unit in units for one in read_rollouts(unit))
    sides: list[Side] = []
    for scenario_id, some in groupby(rollouts, key=lambda one: one.scenario_id):
        scene = logs.find(scenario_id)
        place = Place(scene_road_edges(scene), lane_segments(scene))
        played = [from_rollout(one) for one in some]
        if not sides:
            steps = played[0].motion.valid.shape[2] - played[0].now - 1
            spans = max(1, round(steps * CLOCK.step_s / look.span_s))
            sides = [_empty(spans), _empty(spans)]
        try:
            take(sides[0], from_log(scene, tokens), place, look)
        except TokensError as error:
            print(f"<!-- no log of {scenario_id}: {error} -->")
        for traffic in played:
            take(sides[1], traffic, place, look)
        for side in sides:
            side.end_scene()
    if not sides:
        raise FileNotFoundError(f"{root} has no rollouts")
    return sides[0], sides[1]


def _tokens_of(folder: Path) -> TokenSettings:
    """Settings of a root's tokens: who enters a log, and when, hangs on them."""
    if not folder.exists():
        return TokenSettings()
    values = read_manifest(folder)["settings"]["tokenize"]
    return build(TokenSettings, values, "tokenize")


def _empty(spans: int) -> Side:
    return Side({name: np.zeros((2, spans)) for name in COLUMNS})


def report(logs: Side, played: Side, look: Look) -> dict[str, Any]:
    """Print all tables; return all their numbers."""
    spans = range(logs.sums["agents"].shape[1])
    found: dict[str, Any] = {
        name: {who: _numbers(side.means(name)) for who, side in
               (("logs", logs), ("rollouts", played))}
        for name in COLUMNS
    }  # fmt: skip
    show_table(
        "rollouts (logs)",
        ("seconds", *(head for head, _ in COLUMNS.values())),
        [
            (
                f"{span * look.span_s:g} to {(span + 1) * look.span_s:g}",
                *(
                    f"{_cell(found[name]['rollouts'][span], form)} "
                    f"({_cell(found[name]['logs'][span], form)})"
                    for name, (_, form) in COLUMNS.items()
                ),
            )
            for span in spans
        ],
    )
    found["beside"] = _tell_beside(logs, played, look)
    for who, side in (("logs", logs), ("rollouts", played)):
        after_s = ", ".join(f"{at_s:.0f}" for at_s in sorted(side.left_map_s))
        print(
            f"{who}: the ego left the map in {len(side.left_map_s)} of {side.count} "
            f"(after {after_s or 'no'} s)"
        )
        stood_s = max(side.ego_stood_s, default=0.0)
        print(f"{who}: the ego stands for at most {stood_s:g} s")
        found[f"left_map_{who}_s"], found[f"ego_stood_{who}_s"] = side.left_map_s, stood_s
    found["drift"] = _tell_drift(logs, played)
    inserted = {"logs": logs.inserted.numbers(), "rollouts": played.inserted.numbers()}
    found["inserted"] = inserted
    apart = apart_bits(logs.inserted, played.inserted)
    found |= {name: _numbers(np.atleast_1d(bits))[0] for name, bits in apart.items()}
    show_table(
        "inserted",
        ("", *inserted["logs"]),
        [
            (who, *(_cell(value, ".3f") for value in one.values()))
            for who, one in inserted.items()
        ],
    )
    for name, what in (("first_speed_js", "first speeds"), ("bearing_js", "bearings")):
        told = _cell(found[name], ".3f")
        print(f"{what}, Jensen-Shannon divergence in bits: {told}")
    return found


def _tell_beside(logs: Side, played: Side, look: Look) -> dict[str, Any]:
    """Print by what share figures are above the logs', with their intervals."""
    above = {name: beside(logs, played, name) for name in COLUMNS}
    show_table(
        "above the logs",
        ("seconds", *(head for head, _ in COLUMNS.values())),
        [
            (
                f"{span * look.span_s:g} to {(span + 1) * look.span_s:g}",
                *(_share(*(end[span] for end in one)) for one in above.values()),
            )
            for span in range(logs.sums["agents"].shape[1])
        ],
    )
    return {
        name: [_numbers(np.array(ends)) for ends in zip(*one, strict=True)]
        for name, one in above.items()
    }


def _share(mean: float, low: float, high: float) -> str:
    return "none" if np.isnan(mean) else f"{mean:+.0%} ({low:+.0%} to {high:+.0%})"


def _tell_drift(logs: Side, played: Side) -> dict[str, Any]:
    """Print by how much figures drift, with 95 % of resamples of the scenes."""
    found: dict[str, Any] = {}
    for first in range(min(2, logs.sums["agents"].shape[1] - 1)):
        for who, side in (("logs", logs), ("rollouts", played)):
            some = {name: side.drift(name, first) for name in DRIFTING}
            told = ", ".join(
                f"{COLUMNS[name][0]} {one.mean[0]:+.1%} "
                f"({one.low[0]:+.0%} to {one.high[0]:+.0%})"
                for name, one in some.items()
            )
            print(f"{who}, span {first + 1} to the last: {told}")
            found[f"{who}_from_{first + 1}"] = {
                name: _numbers(np.concatenate(one)) for name, one in some.items()
            }
    return found


def _cell(value: float | None, form: str) -> str:
    return "none" if value is None else format(value, form)


def _numbers(values: np.ndarray) -> list[float | None]:
    return [None if np.isnan(value) else round(float(value), 5) for value in values]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print all tables of a root."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("root", type=Path, help="root with stages ingest and rollout")
    parser.add_argument("--span", type=float, default=10.0, help="seconds per row")
    parser.add_argument("--radius", type=float, default=75.0, help="metres to the ego")
    asked = parser.parse_args(arguments)
    look = Look(asked.span, asked.radius)
    print(json.dumps(report(*measure(asked.root, look), look)))


if __name__ == "__main__":
    main()
