"""How often rollouts insert an agent into another one, by the rules that they have.

The insertion mask is one of the rules of ``rollout.rules``. What it prevents is measured on
built-in scenes that were held out, with the weights of the package and without biases::

    python benchmarks/inserted_overlaps.py [--scenes 6] [--count 4] [--seconds 30]

Pairs of pedestrians are left out: groups walk closer than their boxes. The last row is the
logs of the same scenes.
"""

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int64

import infgen
from infgen.geometry import boxes_overlap
from infgen.metrics.motion import Motion
from infgen.metrics.traffic import Traffic, from_rollout, observe_log
from infgen.rollout.rules.off_road import lane_segments
from infgen.scene import AgentType, Scene
from infgen.spatial.lanes import lanes_distance_m
from pipeline.commands.screen import show_table

RULES: dict[str, dict[str, Any]] = {
    "none": {},
    "insertion mask alone": {
        "rules": "safe",
        "max_motion_samples": 1,
        "reject_off_road": False,
        "max_stall_s": 0.0,
        "density_control": 0.0,
    },
    "safe": {"rules": "safe"},
}
COLUMNS = (
    *("rules", "inserted", "overlap when inserted, %", "vehicles far from lanes, %"),
    *("ever overlap, %", "ever, but not when inserted, %", "agents in the first 10 s"),
    "agents in the last 10 s",
)
LANE_M = 25.0
"""Vehicles farther from every lane are far from lanes."""
NEAR_M = 75.0
"""Agents nearer to the ego are counted."""
LONGEST_M = 30.0
"""Boxes whose middles are farther apart do not overlap."""
PART = 100
"""Steps of the first and the last 10 s."""


@dataclass
class Counts:
    """Sums over rollouts, or logs, of all scenes."""

    inserted: int = 0
    overlapping: int = 0
    vehicles: int = 0
    far: int = 0
    agents: int = 0
    ever: int = 0
    later: int = 0
    first: float = 0.0
    last: float = 0.0
    rollouts: int = 0

    def __add__(self, other: "Counts") -> "Counts":
        return Counts(*map(sum, zip(astuple(self), astuple(other), strict=True)))

    @property
    def cells(self) -> list[str]:
        """The row of the table, without its name."""
        shares = (
            (self.overlapping, self.inserted),
            (self.far, self.vehicles),
            (self.ever, self.agents),
            (self.later, self.agents),
        )
        means = (self.first / self.rollouts, self.last / self.rollouts)
        return [
            str(self.inserted),
            *(f"{100 * part / max(1, whole):.1f}" for part, whole in shares),
            *(f"{mean:.1f}" for mean in means),
        ]


def overlapping(
    motion: Motion, step: int, asked: Int64[np.ndarray, " asked"]
) -> Bool[np.ndarray, " asked"]:
    """Tell which agents overlap another one at a step."""
    pose = np.stack([motion.x_m[0], motion.y_m[0], motion.heading_rad[0]], axis=-1)
    pose, pedestrian = pose[:, step], motion.agent_type == AgentType.PEDESTRIAN
    size_lw_m = motion.size_lwh_m[:, :2]
    other = motion.valid[0, :, step] & ~(pedestrian & pedestrian[asked, None])
    other[np.arange(len(asked)), asked] = False
    away_m = pose[asked, None, :2] - pose[:, :2]
    other &= np.hypot(away_m[..., 0], away_m[..., 1]) < LONGEST_M
    who, row = np.nonzero(other)
    meets = boxes_overlap(
        pose[asked[who]], size_lw_m[asked[who]], pose[row], size_lw_m[row]
    )
    found = np.zeros(len(asked), dtype=bool)
    found[who[meets]] = True
    return found


def count(scene: Scene, traffic: Traffic) -> Counts:
    """Count what is inserted, and overlaps, after now; agents of a log enter likewise."""
    motion, now = traffic.motion, traffic.now
    valid, steps = motion.valid[0], motion.valid.shape[2]
    entered = np.where(valid[:, : now + 1].any(axis=1), -1, valid.argmax(axis=1))
    at_entry, ever = np.zeros(len(valid), dtype=bool), np.zeros(len(valid), dtype=bool)
    for step in range(now + 1, steps):
        new = np.flatnonzero((entered == step) & valid[:, step])
        at_entry[new] = overlapping(motion, step, new)
        there = np.flatnonzero(valid[:, step] & ~ever)
        ever[there] = overlapping(motion, step, there)
    inserted = np.flatnonzero(entered > now)
    vehicles = inserted[motion.agent_type[inserted] == AgentType.VEHICLE]
    first = entered[vehicles]
    points_m = np.zeros((len(vehicles), 3), dtype=np.float32)
    points_m[:, 0] = motion.x_m[0, vehicles, first]
    points_m[:, 1] = motion.y_m[0, vehicles, first]
    far = lanes_distance_m(points_m, *lane_segments(scene)) > LANE_M
    x_m, y_m = (each[0] - each[0, traffic.ego] for each in (motion.x_m, motion.y_m))
    there = valid[:, now + 1 :].any(axis=1)
    near = valid & (np.hypot(x_m, y_m) < NEAR_M)
    others = near[:, now + 1 :].sum(axis=0) - near[traffic.ego, now + 1 :]
    return Counts(
        inserted=len(inserted),
        overlapping=int(at_entry.sum()),
        vehicles=len(vehicles),
        far=int(far.sum()),
        agents=int(there.sum()),
        ever=int(ever.sum()),
        later=int((ever & ~at_entry).sum()),
        first=float(others[:PART].mean()),
        last=float(others[-PART:].mean()),
        rollouts=1,
    )


def counted(scenes: Iterable[Scene], rules: dict[str, Any], **how: Any) -> Iterator[Counts]:
    """Simulate every scene, and count each rollout."""
    simulator = infgen.load("towns", add_bias=0.0, remove_bias=0.0, **rules)
    for scene in scenes:
        for rollout in simulator.rollout(scene, seed=0, **how):
            yield count(scene, from_rollout(rollout))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--count", type=int, default=4, help="rollouts of each scene")
    parser.add_argument("--seconds", type=float, default=30.0)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    scenes = infgen.open_scenes("builtin", split="validation")[: asked.scenes]
    how = {"count": asked.count, "seconds": asked.seconds}
    rows = [
        [name, *sum(counted(scenes, rules, **how), Counts()).cells]
        for name, rules in RULES.items()
    ]
    logs = sum((count(scene, observe_log(scene)) for scene in scenes), Counts())
    show_table("Rollouts by their rules", COLUMNS, [*rows, ["the logs", *logs.cells]])


if __name__ == "__main__":
    main()
