"""Half-second segments of logged tracks: what the motion vocabulary is made from."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int8, UInt64

from infgen.clock import CLOCK, Clock
from infgen.geometry import box_corners, to_local
from infgen.scene import AgentType, Scene
from infgen.tokens.clustering.physical_limits import MotionLimits, plausible, smooth
from infgen.tokens.clustering.sample_keys import item_keys, smallest_keys
from infgen.tokens.tracks import clean_headings
from infgen.tokens.vocabulary import BOX_LW_M

MIN_STEPS = 30
"""Agents observed at fewer steps of a log give no segments; of a short log, a third."""

NUM_AGENT_TYPES = 3


@dataclass(frozen=True, slots=True)
class MotionSamples:
    """Moves cut from logs, ascending by key.

    Attributes:
        key: Identity of the segment (scene, track, start), hashed.
        agent_type: ``AgentType``; none is ``OTHER``.
        path: Poses at steps 0 to 5, in the frame of step 0.
    """

    key: UInt64[np.ndarray, " segment"]
    agent_type: Int8[np.ndarray, " segment"]
    path: Float32[np.ndarray, "segment 6 3"]

    @property
    def num_samples(self) -> int:
        """Number of segments."""
        return len(self.key)

    def of_agent_type(self, agent_type: int) -> Float32[np.ndarray, "motion 6 3"]:
        """Paths of one kind, ascending by key."""
        return self.path[self.agent_type == agent_type]


NO_MOTION_SAMPLES = MotionSamples(
    np.empty(0, np.uint64), np.empty(0, np.int8), np.empty((0, 6, 3), np.float32)
)


def scene_motion_samples(
    scene: Scene, limits: MotionLimits, still_m: float, clock: Clock = CLOCK
) -> MotionSamples:
    """Cut the motion tokens of all road users out of a scene, token by token.

    Left out is motion beyond the limits and motion that stays within ``still_m`` of where
    they start (mean distance of box corners): standing still is known without logs.
    """
    tracks = scene.tracks
    starts = np.arange(clock.num_tokens(tracks.num_steps)) * clock.steps_per_token
    steps = starts[:, None] + np.arange(clock.steps_per_token + 1)  # [start, 6]
    long = tracks.valid.sum(axis=1) >= min(MIN_STEPS, tracks.num_steps // 3)
    whole = tracks.valid[:, steps].all(axis=-1) & long[:, None]  # [agent, start]
    whole &= ((tracks.agent_type >= 0) & (tracks.agent_type < AgentType.OTHER))[:, None]
    agent, start = np.nonzero(whole)

    heading_rad = clean_headings(tracks.heading_rad, tracks.valid)
    pose = np.concatenate([tracks.xyz_m[..., :2], heading_rad[..., None]], axis=-1)
    pose = pose[agent[:, None], steps[start]]  # [segment, 6, 3]
    path, agent_type = to_local(pose, pose[:, :1]), tracks.agent_type[agent]
    found = MotionSamples(
        item_keys(scene.scenario_id, tracks.id[agent], start), agent_type, path
    )
    return _join(
        [
            _usable(found, agent_type, limits, still_m)
            for agent_type in range(NUM_AGENT_TYPES)
        ]
    )


def merge_motion_samples(parts: list[MotionSamples], per_kind: int) -> MotionSamples:
    """Merge segments and keep at most so many of each kind, whatever their order."""
    merged = _join(parts)
    rows = []
    for agent_type in range(NUM_AGENT_TYPES):
        of_agent_type = np.flatnonzero(merged.agent_type == agent_type)
        rows.append(of_agent_type[smallest_keys(merged.key[of_agent_type], per_kind)])
    return _take(merged, np.concatenate(rows))


def corner_gap_m(
    one: Float32[np.ndarray, "*rows 3"],
    two: Float32[np.ndarray, "*rows 3"],
    agent_type: int,
) -> np.ndarray:
    """Return mean distances [rows] of the corners of a kind's box at two poses."""
    away_m = box_corners(one, BOX_LW_M[agent_type]) - box_corners(two, BOX_LW_M[agent_type])
    return np.linalg.norm(away_m, axis=-1).mean(axis=-1)


def _usable(
    found: MotionSamples, agent_type: int, limits: MotionLimits, still_m: float
) -> MotionSamples:
    of_agent_type = _take(found, np.flatnonzero(found.agent_type == agent_type))
    moving = (
        corner_gap_m(of_agent_type.path[:, -1], of_agent_type.path[:, 0], agent_type)
        > still_m
    )
    usable = _take(
        of_agent_type,
        np.flatnonzero(moving & plausible(of_agent_type.path, agent_type, limits)),
    )
    return MotionSamples(
        usable.key, usable.agent_type, smooth(usable.path, agent_type, limits)
    )


def _take(segments: MotionSamples, rows: np.ndarray) -> MotionSamples:
    return MotionSamples(segments.key[rows], segments.agent_type[rows], segments.path[rows])


def _join(parts: list[MotionSamples]) -> MotionSamples:
    return MotionSamples(
        key=np.concatenate([part.key for part in parts]),
        agent_type=np.concatenate([part.agent_type for part in parts]),
        path=np.concatenate([part.path for part in parts]),
    )
