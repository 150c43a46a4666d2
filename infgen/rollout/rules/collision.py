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
        :, :, COMPARED_STEPS
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
) -> Bool[np.ndarray, "rollout row"]:
    """Tell which agents collide with an agent ahead that they did not overlap before.

    Pairs of pedestrians are not checked: groups walk closer than their boxes.

    Args:
        before: All agents at the beginning of the token step.
        there: Agents that are present in it.
        poses: Predicted poses.
    """
    hits = np.zeros(there.shape, dtype=bool)
    rollout, one, two = _near(before, there, poses)
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
    meet &= ~boxes_overlap(starts[0], sizes_m[0], starts[1], sizes_m[1])
    for who, start, other in ((one, *starts), (two, *starts[::-1])):
        ahead = to_local(other, start)[:, 0] > 0
        hits[rollout[meet & ahead], who[meet & ahead]] = True
    return hits


def _near(
    before: Population, there: np.ndarray, poses: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs whose boxes may overlap: rollout and both rows."""
    reach_m = np.linalg.norm(before.size_lwh_m[..., :2], axis=-1) / 2  # [rollout, row]
    near = np.zeros((*there.shape, there.shape[1]), dtype=bool)
    for xy_m in np.moveaxis(poses[..., 1::2, :2], 2, 0):  # at the ends of token steps
        gap_m = np.linalg.norm(xy_m[:, :, None] - xy_m[:, None], axis=-1)
        near |= gap_m < reach_m[:, :, None] + reach_m[:, None] + MARGIN_M
    near &= there[:, :, None] & there[:, None]
    pedestrian = before.agent_type == AgentType.PEDESTRIAN
    near &= ~(pedestrian[:, :, None] & pedestrian[:, None])
    rows = there.shape[1]
    near &= np.triu(np.ones((rows, rows), dtype=bool), 1)
    rollout, one, two = np.nonzero(near)
    return rollout, one, two
