"""Half-second segments of logged tracks: what the motion codebook is made from."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int8, UInt64

from infgen.clock import CLOCK, Clock
from infgen.geometry import box_corners, to_local
from infgen.scene import AgentType, Scene
from infgen.tokens.clustering.physical_limits import MotionLimits, ease, plausible
from infgen.tokens.clustering.sample_keys import item_keys, smallest
from infgen.tokens.tracks import clean_headings
from infgen.tokens.vocabulary import BOX_LW_M

MIN_STEPS = 30
"""Agents observed at fewer steps of a log give no segments; of a short log, a third."""

NUM_KINDS = 3


@dataclass(frozen=True, slots=True)
class Segments:
    """Moves cut from logs, ascending by key.

    Attributes:
        key: Identity of the segment (scene, track, start), hashed.
        kind: ``AgentType``; none is ``OTHER``.
        path: Poses at steps 0 to 5, in the frame of step 0.
    """

    key: UInt64[np.ndarray, " segment"]
    kind: Int8[np.ndarray, " segment"]
    path: Float32[np.ndarray, "segment 6 3"]

    @property
    def num_segments(self) -> int:
        """Number of segments."""
        return len(self.key)

    def of_kind(self, kind: int) -> Float32[np.ndarray, "move 6 3"]:
        """Paths of one kind, ascending by key."""
        return self.path[self.kind == kind]


NO_SEGMENTS = Segments(
    np.empty(0, np.uint64), np.empty(0, np.int8), np.empty((0, 6, 3), np.float32)
)


def scene_segments(
    scene: Scene, limits: MotionLimits, still_m: float, clock: Clock = CLOCK
) -> Segments:
    """Cut the moves of all road users out of a scene, token by token.

    Left out are moves beyond the limits and those that stay within ``still_m`` of where
    they start (mean distance of box corners): standing still is known without logs.
    """
    tracks = scene.tracks
    starts = np.arange(clock.num_tokens(tracks.num_steps)) * clock.steps_per_token
    steps = starts[:, None] + np.arange(clock.steps_per_token + 1)  # [start, 6]
    long = tracks.valid.sum(axis=1) >= min(MIN_STEPS, tracks.num_steps // 3)
    whole = tracks.valid[:, steps].all(axis=-1) & long[:, None]  # [agent, start]
    whole &= ((tracks.kind >= 0) & (tracks.kind < AgentType.OTHER))[:, None]
    agent, start = np.nonzero(whole)

    heading_rad = clean_headings(tracks.heading_rad, tracks.valid)
    pose = np.concatenate([tracks.xyz_m[..., :2], heading_rad[..., None]], axis=-1)
    pose = pose[agent[:, None], steps[start]]  # [segment, 6, 3]
    path, kind = to_local(pose, pose[:, :1]), tracks.kind[agent]
    found = Segments(item_keys(scene.scenario_id, tracks.id[agent], start), kind, path)
    return _join([_usable(found, kind, limits, still_m) for kind in range(NUM_KINDS)])


def sample_segments(parts: list[Segments], per_kind: int) -> Segments:
    """Merge segments and keep at most so many of each kind, whatever their order."""
    merged = _join(parts)
    rows = []
    for kind in range(NUM_KINDS):
        of_kind = np.flatnonzero(merged.kind == kind)
        rows.append(of_kind[smallest(merged.key[of_kind], per_kind)])
    return _take(merged, np.concatenate(rows))


def corner_gap_m(
    one: Float32[np.ndarray, "*rows 3"], two: Float32[np.ndarray, "*rows 3"], kind: int
) -> np.ndarray:
    """Return mean distances [rows] of the corners of a kind's box at two poses."""
    away_m = box_corners(one, BOX_LW_M[kind]) - box_corners(two, BOX_LW_M[kind])
    return np.linalg.norm(away_m, axis=-1).mean(axis=-1)


def _usable(found: Segments, kind: int, limits: MotionLimits, still_m: float) -> Segments:
    of_kind = _take(found, np.flatnonzero(found.kind == kind))
    moves = corner_gap_m(of_kind.path[:, -1], of_kind.path[:, 0], kind) > still_m
    usable = _take(of_kind, np.flatnonzero(moves & plausible(of_kind.path, kind, limits)))
    return Segments(usable.key, usable.kind, ease(usable.path, kind, limits))


def _take(segments: Segments, rows: np.ndarray) -> Segments:
    return Segments(segments.key[rows], segments.kind[rows], segments.path[rows])


def _join(parts: list[Segments]) -> Segments:
    return Segments(
        key=np.concatenate([part.key for part in parts]),
        kind=np.concatenate([part.kind for part in parts]),
        path=np.concatenate([part.path for part in parts]),
    )
