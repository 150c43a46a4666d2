"""The two vocabularies: half-second moves of agents, five-metre pieces of map lines.

A vocabulary is plain arrays. Which rows there are is decided by ``kdisks`` (from logs) and
written and read by ``pipeline.stages.vocabulary``; everything that matches or decodes
tokens needs only what is here.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from infgen.geometry import box_corners

BOX_LW_M = np.array([[4.8, 2.0], [1.0, 1.0], [2.0, 1.0]], dtype=np.float32)
"""Length and width of the box that stands for a vehicle, a pedestrian, a cyclist."""

STATIONARY_TOKEN = 0
"""Row of every kind's vocabulary that goes nowhere."""

STATIONARY_M = 0.1
"""Shorter moves are those of agents that stand (0.2 m/s)."""

MAP_SPACING_M = 0.5
"""Distance along a map line between two points of a piece."""

MAP_SAMPLE_POINTS = (0, 5, 10)
"""Points of a piece that pieces are compared by: first, middle, last."""


@dataclass(frozen=True, eq=False, slots=True)
class MotionVocabulary:
    """The moves that agents choose from, ``num_motion_tokens`` for each of three kinds.

    The same row means another motion for another kind. Row ``STATIONARY_TOKEN`` of each
    kind is the agent that stays where it is.

    Attributes:
        size_lw_m: Box by which moves of each kind (row: ``AgentType``) are compared.
        path: Poses at steps 0 to 5 of each move, in the frame of step 0: pose 0 is zero.
        real: Whether a move is the mean of logged motion; False for a mirrored or made one.
    """

    size_lw_m: Float32[np.ndarray, "3 2"]
    path: Float32[np.ndarray, "3 move 6 3"]
    real: Bool[np.ndarray, "3 move"]

    @property
    def num_motion_tokens(self) -> int:
        """Number of moves per kind."""
        return int(self.path.shape[1])

    @property
    def end_pose(self) -> Float32[np.ndarray, "3 move 3"]:
        """Pose at the end of each move, in the frame of its start."""
        return self.path[:, :, -1]

    @property
    def stationary(self) -> Bool[np.ndarray, "3 move"]:
        """Which moves go nowhere, or hardly anywhere."""
        return np.hypot(*np.moveaxis(self.end_pose[..., :2], -1, 0)) < STATIONARY_M

    @property
    def end_corners_m(self) -> Float32[np.ndarray, "3 move 4 2"]:
        """Corners of each kind's box at the end of each move, in the frame of its start."""
        return box_corners(self.end_pose, self.size_lw_m[:, None])


@dataclass(frozen=True, slots=True)
class MapVocabulary:
    """The shapes that a road token may have.

    Attributes:
        curve_m: Eleven points, evenly spaced along the shape (by 0.5 m in a whole piece,
            less in one cut short); the first at the origin, the first interval along +x.
        real: Whether a shape is the mean of logged lines; False for a mirrored or made one.
    """

    curve_m: Float32[np.ndarray, "road 11 2"]
    real: Bool[np.ndarray, " road"]

    @property
    def num_map_tokens(self) -> int:
        """Number of shapes."""
        return len(self.curve_m)

    @property
    def sample_m(self) -> Float32[np.ndarray, "road 3 2"]:
        """First, middle and last point of each shape."""
        return self.curve_m[:, list(MAP_SAMPLE_POINTS)]
