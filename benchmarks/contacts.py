"""Who runs into whom, and where vehicles stand and drive beside the middle of a lane.

Reads the logs and the rollouts of a root::

    python benchmarks/contacts.py ROOT [--count 4]

The first table has contacts of two agents after now, for each rollout beside each log: in
how many one had been inserted, in how many one stood (slower than 0.5 m/s) when they met,
and between which types; and how long they lasted. Pairs that overlap from now on count.
The second has those of two vehicles that move: at which angle, and in how many one had been
inserted at most 3 s before. The third has vehicles every 5 s: how far from the middle of
the nearest lane, and at which angle to it, those stand and drive that were inserted, and
all others. A vehicle between 0.75 and 1.75 m stands neither in a lane nor beside the road,
and is driven into. "Against" is the share of those in a lane (1 m) that no lane there leads
the way they face. The last line is one JSON object.
"""

import argparse
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from infgen.geometry import boxes_overlap, wrap_angle
from infgen.metrics.kinematics import speed
from infgen.metrics.traffic import Traffic, from_rollout, observe_log
from infgen.rollout.rules.off_road import Lanes, lane_segments
from infgen.scene import AgentType, Scene
from infgen.spatial.road_edges import project
from pipeline.commands.screen import show_table
from pipeline.storage.rollouts import read_rollouts
from pipeline.storage.scene_lookup import open_scene_lookup, unit_folders

STANDS_MPS = 0.5
LONGEST_M = 30.0
"""Boxes whose middles are farther apart do not overlap."""
EVERY_STEPS = 50
NEAR_LANE_M = 6.0
"""Vehicles farther from every lane are left out of the second table."""
BETWEEN_M = (0.75, 1.75)
IN_LANE_M = 1.0
ALONG_RAD = np.radians(45)
"""A lane leads the way of a vehicle if they are no farther turned from each other."""
MEETINGS = (("same way", 20.0), ("merging", 60.0), ("crossing", 120.0), ("head on", 180.0))
"""Contacts of two vehicles that move, by the angle between them, up to so many degrees."""
FRESH = "one inserted within 3 s"
FRESH_STEPS = 30
NAMES = ("vehicles", "pedestrians", "cyclists")
COLUMNS = ("contacts", "one inserted", "one stands", "both stand", "both move")
WHERE = (
    *("vehicles", "0.75 to 1.75 m", "against", "median, m", "90 %, m"),
    *("median angle", "90 %"),
)


@dataclass(slots=True)
class Side:
    """Logs, or rollouts.

    Attributes:
        count: How many.
        kinds: Contacts by kind.
        moving: Those of two vehicles that move, by how they meet.
        lasted_s: Duration of each contact.
        beside: What ``beside_lanes`` tells of vehicles, by where they come from and
            whether they stand.
    """

    count: int = 0
    kinds: Counter[str] = field(default_factory=Counter)
    moving: Counter[str] = field(default_factory=Counter)
    lasted_s: list[float] = field(default_factory=list)
    beside: dict[str, list[np.ndarray]] = field(default_factory=dict)


def take(side: Side, traffic: Traffic, lanes: Lanes) -> None:
    """Measure one log or rollout."""
    motion, now = traffic.motion, traffic.now
    side.count += 1
    known: np.ndarray = np.asarray(motion.valid[0, :, : now + 1].any(axis=1))
    speed_mps = np.nan_to_num(speed(motion.x_m, motion.y_m)[0])
    hit = np.zeros((len(known), len(known), motion.valid.shape[2] - now - 1), dtype=bool)
    for at in range(hit.shape[2]):
        one, other = overlaps(traffic, now + 1 + at)
        hit[one, other, at] = True
    for one, other in np.argwhere(hit.any(axis=2)):
        steps = np.flatnonzero(hit[one, other])
        pair = [one, other]
        types = sorted(motion.agent_type[pair])
        stand = np.count_nonzero(speed_mps[pair, now + 1 + steps[0]] < STANDS_MPS)
        told = [
            "contacts",
            ("both move", "one stands", "both stand")[stand],
            " and ".join(NAMES[each] for each in types),
            *([] if known[pair].all() else ["one inserted"]),
        ]
        side.kinds.update(told)
        if not stand and (motion.agent_type[pair] == AgentType.VEHICLE).all():
            seen = motion.valid[0, pair]
            side.moving.update(meeting(traffic, pair, now + 1 + steps[0], seen))
        side.lasted_s.append(len(steps) / 10)
    vehicle = motion.agent_type == AgentType.VEHICLE
    for step in range(now + EVERY_STEPS, motion.valid.shape[2], EVERY_STEPS):
        stands = speed_mps[:, step] < STANDS_MPS
        for who, origin in (("inserted", ~known), ("others", known)):
            for how, moving in (("stand", stands), ("drive", ~stands)):
                rows = np.flatnonzero(vehicle & motion.valid[0, :, step] & origin & moving)
                found = beside_lanes(traffic, rows, step, lanes)
                side.beside.setdefault(f"{who} that {how}", []).append(found)


def meeting(traffic: Traffic, pair: list[int], step: int, seen: np.ndarray) -> list[str]:
    """Tell how two vehicles meet at a step; ``seen`` is where they are there [2, step]."""
    heading_rad = traffic.motion.heading_rad[0, pair, step]
    angle_deg = np.degrees(np.abs(wrap_angle(np.diff(heading_rad))[0]))
    inserted = ~seen[:, : traffic.now + 1].any(axis=1)
    fresh = inserted & (step - seen.argmax(axis=1) <= FRESH_STEPS)
    told = [name for name, most_deg in MEETINGS if angle_deg <= most_deg][:1]
    return [*told, *([FRESH] if fresh.any() else [])]


def overlaps(traffic: Traffic, step: int) -> tuple[np.ndarray, np.ndarray]:
    """List pairs of agents whose boxes overlap at a step."""
    motion = traffic.motion
    there = np.flatnonzero(motion.valid[0, :, step])
    parts = (motion.x_m, motion.y_m, motion.heading_rad)
    pose = np.stack([part[0, there, step] for part in parts], axis=-1)
    away_m = pose[:, None, :2] - pose[:, :2]
    near = np.hypot(away_m[..., 0], away_m[..., 1]) < LONGEST_M
    one, other = np.nonzero(np.triu(near, 1))
    size_lw_m = motion.size_lwh_m[there, :2]
    meet = boxes_overlap(pose[one], size_lw_m[one], pose[other], size_lw_m[other])
    return there[one[meet]], there[other[meet]]


def beside_lanes(traffic: Traffic, rows: np.ndarray, step: int, lanes: Lanes) -> np.ndarray:
    """Tell where vehicles are to lanes, but for those far from all of them [row, 3].

    Distance from the nearest lane in metres; angle to it, either way, in degrees; distance
    from the nearest one that leads their way.
    """
    start_m, along_m = lanes
    motion = traffic.motion
    points_m = np.zeros((len(rows), 3), dtype=np.float32)
    points_m[:, 0], points_m[:, 1] = motion.x_m[0, rows, step], motion.y_m[0, rows, step]
    if not len(rows) or not len(start_m):
        return np.zeros((0, 3))
    away_m = (points_m[:, None] - start_m)[..., :2]  # [row, segment, 2]
    way_m = np.broadcast_to(along_m[:, :2], away_m.shape)
    share = np.clip(project(away_m, way_m), 0, 1)
    distance_m = np.linalg.norm(away_m - share[..., None] * way_m, axis=2)
    lane_rad = np.arctan2(along_m[:, 1], along_m[:, 0])
    turned_rad = np.abs(wrap_angle(motion.heading_rad[0, rows, step, None] - lane_rad))
    same_way_m = np.where(turned_rad < ALONG_RAD, distance_m, np.inf).min(axis=1)
    at = np.arange(len(rows)), distance_m.argmin(axis=1)
    either_way_rad = np.minimum(turned_rad, np.pi - turned_rad)[at]
    told = np.stack([distance_m[at], np.degrees(either_way_rad), same_way_m], axis=1)
    return told[distance_m[at] < NEAR_LANE_M]


def measure(root: Path, count: int) -> tuple[Side, Side]:
    """Measure the logs that have rollouts in a root, and some rollouts of each.

    Raises:
        FileNotFoundError: if there are none.
    """
    logs, played = Side(), Side()
    for scene, log, rollouts in logs_and_rollouts(root, count):
        lanes = lane_segments(scene)
        take(logs, log, lanes)
        for traffic in rollouts:
            take(played, traffic, lanes)
    return logs, played


def logs_and_rollouts(
    root: Path, count: int
) -> Iterator[tuple[Scene, Traffic, list[Traffic]]]:
    """Read each scene that has rollouts in a root, its log, and its first rollouts.

    Raises:
        FileNotFoundError: if there are none.
    """
    scenes = open_scene_lookup([str((root / "latest" / "ingest").resolve())])
    found = False
    for scenario_id, some in groupby(_rollouts(root), key=lambda one: one.scenario_id):
        rollouts = [traffic for traffic in some if traffic.index < count]
        found |= bool(rollouts)
        scene = scenes.find(scenario_id)
        yield scene, observe_log(scene), rollouts
    if not found:
        raise FileNotFoundError(f"{root} has no rollouts")


def _rollouts(root: Path) -> Iterator[Traffic]:
    for unit in unit_folders(root / "latest" / "rollout") or []:
        yield from map(from_rollout, read_rollouts(unit))


def asked_root(about: str | None, arguments: Sequence[str] | None) -> tuple[Path, int]:
    """Parse a root, and how many rollouts of each scene are looked at."""
    parser = argparse.ArgumentParser(description=(about or "").splitlines()[0])
    parser.add_argument("root", type=Path, help="root with stages ingest and rollout")
    parser.add_argument("--count", type=int, default=4, help="rollouts of each scene")
    asked = parser.parse_args(arguments)
    return asked.root, asked.count


def report(logs: Side, played: Side) -> dict[str, Any]:
    """Print the tables; return their numbers."""
    sides = {"logs": logs, "rollouts": played}
    types = sorted((logs.kinds | played.kinds).keys() - set(COLUMNS))
    found: dict[str, Any] = {}
    for who, side in sides.items():
        found[who] = {name: side.kinds[name] / side.count for name in (*COLUMNS, *types)}
        found[who]["median, s"] = float(np.median(side.lasted_s or [0.0]))
    cells = {who: [f"{value:.2f}" for value in one.values()] for who, one in found.items()}
    rows = [(who, *told) for who, told in cells.items()]
    show_table("contacts of each", ("", *found["logs"]), rows)
    names = (*(name for name, _ in MEETINGS), FRESH)
    rows = []
    for who, side in sides.items():
        met = {name: side.moving[name] / side.count for name in names}
        found[f"{who}: moving"] = met
        rows.append((who, *(f"{value:.2f}" for value in met.values())))
    show_table("contacts of two vehicles that move", ("", *names), rows)
    rows = []
    for who, side in sides.items():
        for name, parts in side.beside.items():
            values = np.concatenate(parts)
            if len(values):
                found[f"{who}: {name}"] = numbers = _spread(values)
                told = [format(value, ".3g") for value in numbers.values()]
                rows.append((f"{who}: {name}", *told))
    show_table("vehicles beside lanes", ("", *WHERE), rows)
    return found


def _spread(values: np.ndarray) -> dict[str, float]:
    distance_m, angle_deg, same_way_m = values.T
    against = (same_way_m > IN_LANE_M)[distance_m < IN_LANE_M]
    between = (distance_m >= BETWEEN_M[0]) & (distance_m < BETWEEN_M[1])
    quantiles = (np.quantile(each, (0.5, 0.9)) for each in (distance_m, angle_deg))
    told = [len(values), between.mean(), against.mean(), *np.concatenate(list(quantiles))]
    return dict(zip(WHERE, map(float, told), strict=True))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables of a root."""
    print(json.dumps(report(*measure(*asked_root(__doc__, arguments)))))


if __name__ == "__main__":
    main()
