"""The presence radius with which placement is most like that of the logs (SPEC 7.1).

Placement needs no boxes and no map, so a radius is tried at the cost of one pass over the
paths. To be tuned on validation, and then set as ``score.presence_radius_m``.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from infgen.metrics.intervals import scene_mean
from infgen.metrics.long_term.binned import Binned
from infgen.metrics.long_term.metric import BUCKETS, bucket_scores, score_binned
from infgen.metrics.long_term.protocols import (
    NUM_FEATURES,
    PLACEMENT,
    PROTOCOLS,
    STEP_FEATURES,
    Protocol,
)
from infgen.metrics.long_term.radius import present_within_radius
from infgen.metrics.long_term.table import Against
from infgen.metrics.placement import simulated_events
from infgen.rollout.rollout import NEVER, Rollout

RADII_M = tuple(float(radius_m) for radius_m in range(20, 125, 5))


class RadiusError(ValueError):
    """Rollouts to which the heuristic does not apply."""


def placement_by_radius(
    rollouts: Iterable[Rollout],
    against: Against,
    protocol: Protocol,
    radii_m: Sequence[float] = RADII_M,
) -> Mapping[float, float]:
    """Score placement at each radius: the bucket of the features' means over scenes.

    Args:
        rollouts: Of a model that neither inserts nor removes; all of a split.
        against: The split's reference.
        protocol: Protocol of the placement score.
        radii_m: To try.

    Raises:
        RadiusError: if agents were inserted or removed, or there are no rollouts.
    """
    at = PROTOCOLS.index(protocol)
    by_scene: dict[str, list[np.ndarray]] = {}  # [radius, feature] of each rollout
    for rollout in rollouts:
        _check(rollout)
        scores = [
            _placement(present_within_radius(rollout, r), against)[at] for r in radii_m
        ]
        by_scene.setdefault(rollout.scenario_id, []).append(np.array(scores))
    if not by_scene:
        raise RadiusError("there are no rollouts to tune a radius on")
    scenes = np.stack([_mean(np.stack(of_scene)) for of_scene in by_scene.values()])
    placement = bucket_scores(_mean(scenes))[:, BUCKETS.index(PLACEMENT)]
    return dict(zip(radii_m, placement.tolist(), strict=True))


def best_radius_m(placement: Mapping[float, float]) -> float:
    """Radius with the best score, the smallest of equals.

    Raises:
        RadiusError: if no radius has a score.
    """
    known = {radius_m: value for radius_m, value in placement.items() if value == value}
    if not known:
        raise RadiusError("no radius has a placement score: are rollouts too short?")
    return min(known, key=lambda radius_m: (-known[radius_m], radius_m))


def _check(rollout: Rollout) -> None:
    """Refuse rollouts with insertions or removals."""
    if not rollout.logged.all() or (rollout.exit_step != NEVER).any():
        raise RadiusError(
            f"scene {rollout.scenario_id}, rollout {rollout.index}: agents were inserted "
            "or removed; a radius is for rollouts made with insert and remove off"
        )


def _placement(rollout: Rollout, against: Against) -> np.ndarray:
    """Scores [protocol, feature] of a rollout, measured only where it is placement."""
    events = simulated_events(rollout)
    steps = rollout.num_steps - rollout.now - 1
    none = np.zeros(steps, dtype=np.int16)
    binned = Binned(
        scenario_id=rollout.scenario_id,
        index=rollout.index,
        there_now=np.zeros(0, dtype=bool),
        bins=np.zeros((len(PROTOCOLS), len(STEP_FEATURES), 0, steps), dtype=np.uint8),
        entry_token=events.entry_token,
        entry_distance_m=events.entry_distance_m,
        exit_token=events.exit_token,
        exit_distance_m=events.exit_distance_m,
        num_near=none,
        num_all=none,
    )
    return score_binned(binned, against.log_p, against.windows(steps)).overall


def _mean(values: np.ndarray) -> np.ndarray:
    """Means over the first axis [one, radius, feature] of what is known."""
    flat = values.reshape(len(values), -1)
    mean = scene_mean(flat, np.ones((1, len(values))))[0]
    return mean.reshape(-1, NUM_FEATURES)
