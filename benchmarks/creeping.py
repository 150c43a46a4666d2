"""How long vehicles creep, and what for.

Reads the logs and the rollouts of a root::

    python benchmarks/creeping.py ROOT [--count 4]

The first table has vehicles every half second after now: the shares that stand, creep (0.5
to 2.5 m/s) and drive, and how fast all that move are. The second has those that creep for
four seconds or more without a break, of each log and rollout: how many had another agent
within 12 m ahead halfway, and what they did before and afterwards. The last line is one
JSON object.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from contacts import asked_root, logs_and_rollouts

from infgen.clock import CLOCK
from infgen.metrics.kinematics import speed
from infgen.metrics.traffic import Traffic
from infgen.model.training.policy_gradient.avoided.creeping import CREEPS_M, is_behind
from infgen.scene import AgentType
from pipeline.commands.screen import show_table

CREEPS_MPS = tuple(each_m / CLOCK.token_s for each_m in CREEPS_M)
FASTEST_MPS = 40.0
"""Faster ones have not been there a tenth of a second before."""
LONG_STEPS = 40
EVERY_STEPS = 5
HOW = ("stand", "creep", "drive")
RUNS = (
    "of each",
    "behind another",
    "stood before",
    "drove before",
    "stand then",
    "drive then",
)


@dataclass(slots=True)
class Side:
    """Logs, or rollouts.

    Attributes:
        count: How many.
        speed_mps: Of vehicles, every half second.
        runs: What is told of each long one that creeps, as ``RUNS`` but for the first.
    """

    count: int = 0
    speed_mps: list[np.ndarray] = field(default_factory=list)
    runs: list[tuple[bool, ...]] = field(default_factory=list)


def take(side: Side, traffic: Traffic) -> None:
    """Measure one log or rollout."""
    motion, now = traffic.motion, traffic.now
    side.count += 1
    vehicle = motion.agent_type == AgentType.VEHICLE
    speed_mps = speed(motion.x_m, motion.y_m)[0]
    there = motion.valid[0] & vehicle[:, None] & (speed_mps < FASTEST_MPS)
    there[:, : now + 1] = False
    some = there[:, now + 1 :: EVERY_STEPS]
    side.speed_mps.append(speed_mps[:, now + 1 :: EVERY_STEPS][some])
    parts = motion.x_m, motion.y_m, motion.heading_rad
    slow, fast = CREEPS_MPS
    creeps = there & (speed_mps >= slow) & (speed_mps <= fast)
    edges = np.diff(np.pad(creeps, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    begins, ends = np.argwhere(edges == 1), np.argwhere(edges == -1)
    for (agent, begin), (_, end) in zip(begins, ends, strict=True):
        if end - begin >= LONG_STEPS:
            around = [
                speed_mps[agent, at] for at in (begin - 1, min(end, there.shape[1] - 1))
            ]
            before, then = (x if x < FASTEST_MPS else np.nan for x in around)
            step = (begin + end) // 2
            pose = np.stack([part[0, :, step] for part in parts], axis=-1)
            there_then = motion.valid[:1, :, step]
            behind = is_behind(pose[None], there_then, np.array([agent]))[0]
            told = behind, before < slow, before > fast, then < slow, then > fast
            side.runs.append(tuple(map(bool, told)))


def measure(root: Path, count: int) -> tuple[Side, Side]:
    """Measure the logs that have rollouts in a root, and some rollouts of each.

    Raises:
        FileNotFoundError: if there are none.
    """
    logs, played = Side(), Side()
    for _, log, rollouts in logs_and_rollouts(root, count):
        take(logs, log)
        for traffic in rollouts:
            take(played, traffic)
    return logs, played


def report(logs: Side, played: Side) -> dict[str, Any]:
    """Print the tables; return their numbers."""
    found: dict[str, Any] = {}
    for who, side in (("logs", logs), ("rollouts", played)):
        speed_mps = np.concatenate(side.speed_mps)
        group = np.searchsorted(CREEPS_MPS, speed_mps)
        shares = np.bincount(group, minlength=len(HOW)) / max(len(group), 1)
        moving_mps = float(speed_mps[group > 0].mean()) if group.any() else 0.0
        told = np.array(side.runs, dtype=float).reshape(-1, len(RUNS) - 1)
        runs = [
            len(told) / side.count,
            *(told.mean(axis=0) if len(told) else told.sum(axis=0)),
        ]
        found[who] = {
            **dict(zip(HOW, shares.tolist(), strict=True)),
            "moving_mps": moving_mps,
            "runs": dict(zip(RUNS, map(float, runs), strict=True)),
        }
    rows = [
        (who, *(f"{100 * one[how]:.1f} %" for how in HOW), f"{one['moving_mps']:.2f}")
        for who, one in found.items()
    ]
    show_table("vehicles every half second", ("", *HOW, "those that move, m/s"), rows)
    rows = [
        (who, *(f"{x:.2f}" for x in one["runs"].values())) for who, one in found.items()
    ]
    show_table("vehicles that creep for 4 s or more", ("", *RUNS), rows)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables of a root."""
    print(json.dumps(report(*measure(*asked_root(__doc__, arguments)))))


if __name__ == "__main__":
    main()
