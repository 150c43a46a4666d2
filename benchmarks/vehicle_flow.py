"""Where vehicles that drive, and that stand, are inserted and removed: rollouts and logs.

Reads the logs' tokens and the rollouts of a root::

    python benchmarks/vehicle_flow.py ROOT

Half second by half second after now, by distance to the ego: how many vehicles there are,
the share of them that is gone half a second later, and how many in 10 s are inserted, where
they are after their first half second. Speeds and counts may be right in sum though those
that drive come and go too close to the ego. Logs are as they are tokenized, so short gaps
of a track are no removals; rollouts count to their end, also where the ego leaves the
map. The last line is one JSON object.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True, slots=True)
class Tracks:
    """Agents of a log or rollout at the token steps from now on.

    Attributes:
        xy_m: Where they are.
        there: Whether they are, from the end of their first half second on.
        is_vehicle: Whether they are vehicles other than the ego.
        ego: Row of the ego.
    """

    xy_m: Float[np.ndarray, "agent token 2"]
    there: Bool[np.ndarray, "agent token"]
    is_vehicle: Bool[np.ndarray, " agent"]
    ego: int


def tracks_of_log(scene: SceneTokens) -> Tracks:
    """Read a tokenized log."""
    return Tracks(
        scene.pose[:, scene.now :, :2],
        scene.presence[:, scene.now :] == Presence.PRESENT,
        _is_vehicle(scene.agent_type, scene.ego),
        scene.ego,
    )


def tracks_of_rollout(rollout: Rollout) -> Tracks:
    """Read a rollout."""
    steps = slice(rollout.now, None, CLOCK.steps_per_token)
    return Tracks(
        rollout.xyz_m[:, steps, :2],
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


def report(logs: list[dict[str, Any]], rollouts: list[dict[str, Any]]) -> None:
    """Print the table."""
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Look at a root's rollouts, and at the logs that they go on from."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("root", type=Path, help="root with stages tokenize and rollout")
    root = parser.parse_args(arguments).root
    played: dict[str, np.ndarray] = {}
    for unit in unit_folders(root / "latest" / "rollout") or []:
        for rollout in read_rollouts(unit):
            found = flow(tracks_of_rollout(rollout))
            played[rollout.scenario_id] = played.get(rollout.scenario_id, 0) + found
    scenes = TokenScenes(shards(root))
    logged = [
        flow(tracks_of_log(scene))
        for scene in (scenes[row] for row in range(len(scenes)))
        if scene.scenario_id in played
    ]
    if not logged:
        parser.error(f"{root} has no rollouts, or no tokens of their scenes")
    logs, rollouts = rows_of(np.sum(logged, 0)), rows_of(np.sum(list(played.values()), 0))
    report(logs, rollouts)
    print(json.dumps({"scenes": len(logged), "logs": logs, "rollouts": rollouts}))


if __name__ == "__main__":
    main()
