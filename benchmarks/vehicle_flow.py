"""Where vehicles that drive, and that stand, are inserted and removed: rollouts and logs.

Reads the logs' tokens and the rollouts of a root::

    python benchmarks/vehicle_flow.py ROOT

Half second by half second after now, by distance to the ego: how many vehicles there are,
the share of them that is gone half a second later, and how many in 10 s are inserted, where
they are after their first half second. Speeds and counts may be right in sum though those
that drive come and go too close to the ego. The second table has the inserted ones by
whether they face away from the ego, towards it or past it (by more than 60 degrees), and
the share that drives on in the next half second: at the edge of what an ego sees, logs
have few that drive away. Logs are as they are tokenized, so short gaps of a track are no
removals; rollouts count to their end, also where the ego leaves the map. The last line is
one JSON object.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from loader import shards

from infgen.clock import CLOCK
from infgen.rollout.rollout import Rollout
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import Presence, SceneTokens
from pipeline.commands.screen import show_table
from pipeline.stages.train.loader import TokenScenes
from pipeline.storage.rollouts import read_rollouts
from pipeline.storage.scene_lookup import unit_folders

DRIVING_M = 0.5
"""Who moves farther in half a second drives."""
RING_EDGES_M = (0.0, 20.0, 40.0, 55.0, 65.0, 75.0)
"""Distances to the ego; the last ring has no end."""
STATES = ("drives", "stands")
FIGURES = ("present", "removed", "inserted", "token steps")
WAYS = ("away", "past", "towards")
ALONG = 0.5
"""Who faces away from the ego, or towards it, has a cosine beyond it."""


@dataclass(frozen=True, slots=True)
class Tracks:
    """Agents of a log or rollout at the token steps from now on.

    Attributes:
        xy_m: Where they are.
        heading_rad: Which way they face.
        there: Whether they are, from the end of their first half second on.
        is_vehicle: Whether they are vehicles other than the ego.
        ego: Row of the ego.
    """

    xy_m: Float[np.ndarray, "agent token 2"]
    heading_rad: Float[np.ndarray, "agent token"]
    there: Bool[np.ndarray, "agent token"]
    is_vehicle: Bool[np.ndarray, " agent"]
    ego: int


def tracks_of_log(scene: SceneTokens) -> Tracks:
    """Read a tokenized log."""
    return Tracks(
        scene.pose[:, scene.now :, :2],
        scene.pose[:, scene.now :, 2],
        scene.presence[:, scene.now :] == Presence.PRESENT,
        _is_vehicle(scene.agent_type, scene.ego),
        scene.ego,
    )


def tracks_of_rollout(rollout: Rollout) -> Tracks:
    """Read a rollout."""
    steps = slice(rollout.now, None, CLOCK.steps_per_token)
    return Tracks(
        rollout.xyz_m[:, steps, :2],
        rollout.heading_rad[:, steps],
        rollout.valid[:, steps],
        _is_vehicle(rollout.agent_type, rollout.ego),
        rollout.ego,
    )


def _is_vehicle(agent_type: Int[np.ndarray, " agent"], ego: int) -> np.ndarray:
    return (agent_type == AgentType.VEHICLE) & (np.arange(len(agent_type)) != ego)


def flow(tracks: Tracks) -> Float64[np.ndarray, "figure state ring"]:
    """Count ``FIGURES`` of a log or rollout; token steps are the same in each ring.

    The last token step counts nothing, as nothing tells who is removed at its end.
    """
    there = tracks.there[tracks.is_vehicle]
    xy_m = tracks.xy_m[tracks.is_vehicle].astype(np.float64)
    both = there[:, 1:] & there[:, :-1]
    step_m = np.where(both, np.linalg.norm(np.diff(xy_m, axis=1), axis=-1), np.nan)
    unknown = np.full_like(step_m[:, :1], np.nan)
    before_m = np.concatenate([unknown, step_m], axis=1)
    after_m = np.concatenate([step_m, unknown], axis=1)
    # Who was not there before is judged by what it does next; who is gone then, stands.
    drives = np.where(np.isnan(before_m), after_m, before_m) > DRIVING_M
    away_m = np.linalg.norm(xy_m - tracks.xy_m[tracks.ego].astype(np.float64), axis=-1)
    ring = np.digitize(away_m, RING_EDGES_M[1:])
    group = np.where(drives, 0, len(RING_EDGES_M)) + ring
    inserted = np.zeros_like(there)
    inserted[:, 1:] = there[:, 1:] & ~there[:, :-1]
    removed = there[:, :-1] & ~there[:, 1:]
    counted = (there[:, :-1], removed, inserted[:, :-1])
    groups = len(STATES) * len(RING_EDGES_M)
    found = [np.bincount(group[:, :-1][mask], minlength=groups) for mask in counted]
    steps = np.full(groups, there.shape[1] - 1)
    return np.stack([*found, steps]).reshape(len(FIGURES), len(STATES), -1).astype(float)


def ways(tracks: Tracks) -> Float64[np.ndarray, "figure way ring"]:
    """Count inserted vehicles of a log or rollout, and those of them that drive on.

    Those that are gone after their first half second count in neither; token steps, the
    third figure, are the same in each ring.
    """
    there = tracks.there[tracks.is_vehicle]
    xy_m = tracks.xy_m[tracks.is_vehicle].astype(np.float64)
    heading_rad = tracks.heading_rad[tracks.is_vehicle]
    row, before = np.nonzero(~there[:, :-2] & there[:, 1:-1] & there[:, 2:])
    at = before + 1
    from_ego_m = xy_m[row, at] - tracks.xy_m[tracks.ego, at].astype(np.float64)
    away_m = np.linalg.norm(from_ego_m, axis=-1)
    facing = np.stack([np.cos(heading_rad[row, at]), np.sin(heading_rad[row, at])], axis=-1)
    cosine = (facing * from_ego_m).sum(axis=-1) / np.maximum(away_m, 1e-6)
    way = np.where(cosine > ALONG, 0, np.where(cosine < -ALONG, 2, 1))
    drives = np.linalg.norm(xy_m[row, at + 1] - xy_m[row, at], axis=-1) > DRIVING_M
    group = way * len(RING_EDGES_M) + np.digitize(away_m, RING_EDGES_M[1:])
    groups = len(WAYS) * len(RING_EDGES_M)
    found = [
        np.bincount(group[mask], minlength=groups)
        for mask in (np.ones_like(drives), drives)
    ]
    steps = np.full(groups, there.shape[1] - 1)
    return np.stack([*found, steps]).reshape(3, len(WAYS), -1).astype(float)


def ways_rows(found: Float64[np.ndarray, "figure way ring"]) -> list[dict[str, Any]]:
    """Tell the figures of each way and ring: rates and shares."""
    inserted, drive, steps = found
    return [
        {
            "faces": way,
            "away_m": least_m,
            "inserted_per_10s": inserted[at, ring] / steps[at, ring] * 10 / CLOCK.token_s,
            "drives": drive[at, ring] / max(inserted[at, ring], 1),
        }
        for at, way in enumerate(WAYS)
        for ring, least_m in enumerate(RING_EDGES_M)
    ]


def rows_of(found: Float64[np.ndarray, "figure state ring"]) -> list[dict[str, Any]]:
    """Tell the figures of each state and ring: means, shares and rates."""
    present, removed, inserted, steps = found
    rows = []
    for at, state in enumerate(STATES):
        for ring, least_m in enumerate(RING_EDGES_M):
            of = at, ring
            rows.append(
                {
                    "vehicle": state,
                    "away_m": least_m,
                    "present": present[of] / steps[of],
                    "removed": removed[of] / max(present[of], 1),
                    "inserted_per_10s": inserted[of] / steps[of] * 10 / CLOCK.token_s,
                }
            )
    return rows


def report_ways(logs: list[dict[str, Any]], rollouts: list[dict[str, Any]]) -> None:
    """Print the second table."""
    show_table(
        "inserted vehicles by where they face: rollouts (logs)",
        ("faces", "m to the ego, from", "inserted in 10 s", "drives on"),
        [
            (
                ours["faces"],
                f"{ours['away_m']:.0f}",
                f"{ours['inserted_per_10s']:.2f} ({theirs['inserted_per_10s']:.2f})",
                f"{ours['drives']:.1%} ({theirs['drives']:.1%})",
            )
            for ours, theirs in zip(rollouts, logs, strict=True)
        ],
    )


def report(logs: list[dict[str, Any]], rollouts: list[dict[str, Any]]) -> None:
    """Print the first table."""
    show_table(
        "vehicles after now: rollouts (logs)",
        ("vehicle", "m to the ego, from", "present", "removed", "inserted in 10 s"),
        [
            (
                ours["vehicle"],
                f"{ours['away_m']:.0f}",
                f"{ours['present']:.2f} ({theirs['present']:.2f})",
                f"{ours['removed']:.1%} ({theirs['removed']:.1%})",
                f"{ours['inserted_per_10s']:.2f} ({theirs['inserted_per_10s']:.2f})",
            )
            for ours, theirs in zip(rollouts, logs, strict=True)
        ],
    )


@dataclass(slots=True)
class _Sums:
    """What ``flow`` and ``ways`` count in all logs, or all rollouts."""

    flow: np.ndarray = field(
        default_factory=lambda: np.zeros((len(FIGURES), len(STATES), len(RING_EDGES_M)))
    )
    ways: np.ndarray = field(
        default_factory=lambda: np.zeros((3, len(WAYS), len(RING_EDGES_M)))
    )

    def take(self, tracks: Tracks) -> None:
        self.flow = self.flow + flow(tracks)
        self.ways = self.ways + ways(tracks)


def main(arguments: Sequence[str] | None = None) -> None:
    """Look at a root's rollouts, and at the logs that they go on from."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("root", type=Path, help="root with stages tokenize and rollout")
    root = parser.parse_args(arguments).root
    played, simulated = _Sums(), set()
    for unit in unit_folders(root / "latest" / "rollout") or []:
        for rollout in read_rollouts(unit):
            played.take(tracks_of_rollout(rollout))
            simulated.add(rollout.scenario_id)
    scenes, logged, count = TokenScenes(shards(root)), _Sums(), 0
    for row in range(len(scenes)):
        scene = scenes[row]
        if scene.scenario_id in simulated:
            logged.take(tracks_of_log(scene))
            count += 1
    if not count:
        parser.error(f"{root} has no rollouts, or no tokens of their scenes")
    logs, rollouts = rows_of(logged.flow), rows_of(played.flow)
    report(logs, rollouts)
    found = {"scenes": count, "logs": logs, "rollouts": rollouts}
    logs, rollouts = ways_rows(logged.ways), ways_rows(played.ways)
    report_ways(logs, rollouts)
    print(json.dumps(found | {"logs_inserted": logs, "rollouts_inserted": rollouts}))


if __name__ == "__main__":
    main()
