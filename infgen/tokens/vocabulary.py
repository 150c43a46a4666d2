"""The two vocabularies: half-second motion tokens, and map tokens of up to five metres.

A vocabulary is plain arrays. ``clustering`` makes its rows from logs; they are written and
read by ``pipeline.stages.vocabulary``; everything that matches or decodes tokens needs only
what is here.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float32

from infgen.geometry import box_corners

BOX_LW_M = np.array([[4.8, 2.0], [1.0, 1.0], [2.0, 1.0]], dtype=np.float32)
"""Length and width of the box that stands for a vehicle, a pedestrian, a cyclist."""

STATIONARY_TOKEN = 0
"""Motion token of zero displacement, of every agent type."""

STATIONARY_M = 0.1
"""Shorter motion tokens count as stationary (0.2 m/s)."""

MAP_SPACING_M = 0.5
"""Distance along a polyline between two points of a map token."""

MAP_SAMPLE_POINTS = (0, 5, 10)
"""Points by which map tokens are compared: first, middle, last."""


@dataclass(frozen=True, eq=False, slots=True)
class MotionVocabulary:
    """Motion tokens, ``num_motion_tokens`` for each of the three agent types.

    The same row is another motion for another agent type. Row ``STATIONARY_TOKEN`` of each
    type stays in place.

    Attributes:
        size_lw_m: Box by which motion tokens are compared (row: ``AgentType``).
        path: Poses at steps 0 to 5 of each motion token, in the frame of step 0: pose 0 is
            zero.
        real: Whether a motion token is the mean of logged motion; False for a mirrored or
            made one.
    """

    size_lw_m: Float32[np.ndarray, "3 2"]
    path: Float32[np.ndarray, "3 motion 6 3"]
    real: Bool[np.ndarray, "3 motion"]

    @property
    def num_motion_tokens(self) -> int:
        """Number of motion tokens per agent type."""
        return int(self.path.shape[1])

    @property
    def end_pose(self) -> Float32[np.ndarray, "3 motion 3"]:
        """Pose at the end of each motion token, in the frame of its start."""
        return self.path[:, :, -1]

    @property
    def stationary(self) -> Bool[np.ndarray, "3 motion"]:
        """Whether each motion token is shorter than ``STATIONARY_M``."""
        return _stationary(self)

    @property
    def end_corners_m(self) -> Float32[np.ndarray, "3 motion 4 2"]:
        """Corners of the box at the end of each motion token, in the frame of its start."""
        return box_corners(self.end_pose, self.size_lw_m[:, None])


@lru_cache(maxsize=8)
def _stationary(vocabulary: MotionVocabulary) -> Bool[np.ndarray, "3 motion"]:
    """Compute ``MotionVocabulary.stationary``: it is asked for at every rejection."""
    return np.hypot(*np.moveaxis(vocabulary.end_pose[..., :2], -1, 0)) < STATIONARY_M


@dataclass(frozen=True, slots=True)
class MapVocabulary:
    """The shapes of map tokens.

    Attributes:
        curve_m: Eleven points, evenly spaced along the shape (by 0.5 m in a whole piece,
            less in one cut short); the first at the origin, the first interval along +x.
        real: Whether a shape is the mean of logged lines; False for a mirrored or made one.
    """

    curve_m: Float32[np.ndarray, "map_token 11 2"]
    real: Bool[np.ndarray, " map_token"]

    @property
    def num_map_tokens(self) -> int:
        """Number of shapes."""
        return len(self.curve_m)

    @property
    def sample_m(self) -> Float32[np.ndarray, "map_token 3 2"]:
        """First, middle and last point of each shape."""
        return self.curve_m[:, list(MAP_SAMPLE_POINTS)]
