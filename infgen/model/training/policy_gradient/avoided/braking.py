"""Where agents get that brake after a motion token, on a given path."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64

from infgen.clock import CLOCK
from infgen.geometry import to_world, wrap_angle

BRAKES_MPS2 = 3.0
"""Deceleration of an agent that averts an overlap."""
LOOK_AHEAD_TOKENS = 5
"""Token steps, that of the motion token included, in which overlaps are looked for."""


@dataclass(frozen=True, slots=True)
class AgentPath:
    """Paths of agents in a rollout, straight on from where they end.

    Attributes:
        pose: Poses at half token steps [row, time, 3].
        arc_m: Arc lengths until there [row, time].
    """

    pose: Float32[np.ndarray, "row time 3"]
    arc_m: Float32[np.ndarray, "row time"]

    @classmethod
    def of(
        cls,
        pose: Float32[np.ndarray, "row time 3"],
        visible: Bool[np.ndarray, "row time"],
    ) -> "AgentPath":
        """Take the poses of agents up to the first time at which they are not there."""
        last = np.maximum(np.logical_and.accumulate(visible, axis=1).sum(axis=1) - 1, 0)
        kept = np.minimum(np.arange(pose.shape[1]), last[:, None])
        pose = np.take_along_axis(pose, kept[..., None], axis=1)
        step_m = np.linalg.norm(np.diff(pose[..., :2], axis=1), axis=-1)
        arc_m = np.zeros(pose.shape[:2], dtype=np.float32)
        step_m.cumsum(axis=1, out=arc_m[:, 1:])
        return cls(pose, arc_m)

    def at(
        self,
        row: Int64[np.ndarray, " choice"],
        arc_m: Float32[np.ndarray, "choice time"],
    ) -> Float32[np.ndarray, "choice time 3"]:
        """Poses at arc lengths of the paths of some rows; beyond the end straight on."""
        row, ends_m = row[:, None], self.arc_m[row]
        part = (arc_m[..., None] >= ends_m[:, None, 1:]).sum(axis=-1)
        part = part.clip(max=ends_m.shape[1] - 2)
        begin, end = self.pose[row, part], self.pose[row, part + 1]
        begin_m, end_m = self.arc_m[row, part], self.arc_m[row, part + 1]
        length_m = end_m - begin_m
        share = np.divide(
            arc_m - begin_m, length_m, out=np.zeros_like(arc_m), where=length_m > 0
        ).clip(max=1)
        pose = begin.copy()
        pose[..., :2] += share[..., None] * (end - begin)[..., :2]
        pose[..., 2] += share * wrap_angle(end[..., 2] - begin[..., 2])
        beyond = np.zeros_like(pose)
        beyond[..., 0] = (arc_m - end_m).clip(min=0)
        return to_world(beyond, pose)


def braking_arc_m(
    token_m: Float32[np.ndarray, " choice"], times: int
) -> Float32[np.ndarray, "choice time"]:
    """Arc lengths at the middle and the end of a motion token, and of braking then.

    Args:
        token_m: Length of each motion token, 0 or more.
        times: Half token steps, those of the motion token included.
    """
    speed_mps = token_m[:, None] / np.float32(CLOCK.token_s)
    braked_s = np.arange(-1, times - 1, dtype=np.float32) * np.float32(CLOCK.token_s / 2)
    braked_s = np.minimum(braked_s, speed_mps / BRAKES_MPS2).clip(min=0)
    arc_m = token_m[:, None] + (speed_mps - BRAKES_MPS2 / 2 * braked_s) * braked_s
    arc_m[:, 0] = token_m / 2
    return arc_m
