"""Collision check: boxes that overlap soon if every agent repeats its motion token."""

import numpy as np
from jaxtyping import Bool, Float32, Int64

from infgen.geometry import boxes_overlap, to_local, to_world
from infgen.rollout.population import Population
from infgen.scene import AgentType
from infgen.tokens.vocabulary import MotionVocabulary

COMPARED_STEPS = (3, 5)
"""Steps of a token step at which boxes are compared: its middle and its end."""
MARGIN_M = 3.0
"""Boxes this far apart at the end of a token step may have overlapped before."""


def repeat(
    before: Population,
    motion_token: Int64[np.ndarray, "rollout row"],
    vocabulary: MotionVocabulary,
    times: int,
) -> Float32[np.ndarray, "rollout row time 3"]:
    """Poses at ``COMPARED_STEPS`` if every agent repeats its motion token."""
    steps = vocabulary.path[before.agent_type, motion_token][
        ..., COMPARED_STEPS, :
    ]  # [rollout, row, time, 3]
    pose, found = before.pose, []
    for _ in range(times):
        found.append(to_world(steps, pose[:, :, None]))
        pose = found[-1][:, :, -1]
    return np.concatenate(found, axis=2).astype(np.float32)


def find_collisions(
    before: Population,
    there: Bool[np.ndarray, "rollout row"],
    poses: Float32[np.ndarray, "rollout row time 3"],
    drawn: Bool[np.ndarray, "rollout row"] | None = None,
) -> Bool[np.ndarray, "rollout row"]:
    """Tell which agents collide with an agent ahead that they did not overlap before.

    Pairs of pedestrians are not checked: groups walk closer than their boxes.

    Args:
        before: All agents at the beginning of the token step.
        there: Agents that are present in it.
        poses: Predicted poses.
        drawn: Only pairs with one of these agents are checked; None for all pairs.
    """
    hits = np.zeros(there.shape, dtype=bool)
    rollout, one, two = _near(before, there, poses, there if drawn is None else drawn)
    if not len(rollout):
        return hits
    size_lw_m = before.size_lwh_m[..., :2]
    sizes_m = size_lw_m[rollout, one], size_lw_m[rollout, two]
    starts = before.pose[rollout, one], before.pose[rollout, two]
    meet = boxes_overlap(
        poses[rollout, one],
        sizes_m[0][:, None],
        poses[rollout, two],
        sizes_m[1][:, None],
    ).any(axis=1)
    (pair,) = np.nonzero(meet)
    apart = ~boxes_overlap(
        starts[0][pair], sizes_m[0][pair], starts[1][pair], sizes_m[1][pair]
    )
    pair = pair[apart]
    for who, start, other in ((one, *starts), (two, *starts[::-1])):
        ahead = pair[to_local(other[pair], start[pair])[:, 0] > 0]
        hits[rollout[ahead], who[ahead]] = True
    return hits


def _near(
    before: Population, there: np.ndarray, poses: np.ndarray, drawn: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs whose boxes may overlap: rollout, a drawn row and another row."""
    reach_m = _length_m(before.size_lwh_m[..., 0], before.size_lwh_m[..., 1]) / 2
    first, second = np.nonzero(drawn & there)
    # Far pairs are ruled out by where they are now and how far they get, with a margin that
    # covers rounding; one axis at a time: sums over a last dimension of two are slow.
    ends_m = np.moveaxis(poses[:, :, 1::2, :2], 3, 0)  # [axis, rollout, row, token step]
    x_m, y_m = before.pose[..., 0], before.pose[..., 1]
    travel_m = _length_m(*(ends_m - np.stack([x_m, y_m])[..., None])).max(axis=2)
    around_m = reach_m + travel_m + MARGIN_M
    away_x_m = x_m[first] - x_m[first, second, None]
    away_y_m = y_m[first] - y_m[first, second, None]
    wide_m = around_m[first] + around_m[first, second, None]
    near = away_x_m * away_x_m + away_y_m * away_y_m < wide_m * wide_m
    near &= there[first]
    # Each pair once: with the lower row first, or with the only drawn one.
    row = np.arange(there.shape[1])
    near &= (row > second[:, None]) | ~drawn[first] & (row != second[:, None])
    at, other = np.nonzero(near)
    rollout, row = first[at], second[at]
    pedestrian = before.agent_type == AgentType.PEDESTRIAN
    kept = ~(pedestrian[rollout, row] & pedestrian[rollout, other])
    rollout, row, other = rollout[kept], row[kept], other[kept]
    reach_m = reach_m[rollout, row] + reach_m[rollout, other] + MARGIN_M
    away_m = ends_m[:, rollout, row] - ends_m[:, rollout, other]
    near = (_length_m(*away_m) < reach_m[:, None]).any(axis=1)
    return rollout[near], row[near], other[near]


def _length_m(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    length_m: np.ndarray = np.sqrt(x_m * x_m + y_m * y_m)
    return length_m
