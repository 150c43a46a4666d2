"""One arm of a junction: its middle line outward from the mouth, and what lies beside it.

Across an arm, ``left_m`` counts to the left of someone looking out of the junction. Traffic
on the right: outgoing lanes lie at negative ``left_m``, incoming ones at positive.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float64

from infgen.sources.towns import curves
from infgen.sources.towns.curves import Points

LANE_WIDTH_M = 3.5
WALK_FROM_KERB_M = 1.5
CROSSWALK_M = (0.9, 3.9)
"""Where along an arm its crosswalk begins and ends."""
STOP_LINE_M = 5.2
"""Where along an arm incoming traffic stops."""

_SPACING_M = 0.5


class Verge(Enum):
    """What lies between the lanes and the kerb; its width in metres."""

    GUTTER = 0.5
    BIKE_LANE = 1.8
    PARKING = 2.4


@dataclass(frozen=True, slots=True)
class Arm:
    """One arm.

    Attributes:
        middle_m: Middle line from the mouth outward.
        num_lanes: Lanes each way.
        verge: What lies beside them.
        limit_mph: Speed limit.
        crosswalk: Whether there is one at its mouth.
        lined: Whether lanes of opposite direction are kept apart by a line.
    """

    middle_m: Points
    num_lanes: int
    verge: Verge
    limit_mph: float
    crosswalk: bool
    lined: bool

    @property
    def lanes_m(self) -> float:
        """Width of the lanes of one direction."""
        return self.num_lanes * LANE_WIDTH_M

    @property
    def half_m(self) -> float:
        """From the middle line to the kerb."""
        return self.lanes_m + self.verge.value

    @property
    def walk_m(self) -> float:
        """From the middle line to the middle of the pavement."""
        return self.half_m + WALK_FROM_KERB_M

    @property
    def length_m(self) -> float:
        """From the mouth to its end."""
        return curves.length(self.middle_m)

    def lane_left_m(self, lane: int) -> float:
        """Distance from the middle line to the middle of a lane (0: the innermost)."""
        return (lane + 0.5) * LANE_WIDTH_M

    def outward(self, left_m: float, from_m: float, to_m: float | None = None) -> Points:
        """Draw a parallel to the middle, outward, between two distances from the mouth."""
        end_m = self.length_m if to_m is None else to_m
        middle_m = curves.cut(self.middle_m, from_m, end_m, _SPACING_M)
        return curves.offset(middle_m, left_m)

    def inward(self, left_m: float, to_m: float) -> Points:
        """Draw a parallel to the middle from its outer end to so far from the mouth."""
        return self.outward(left_m, to_m)[::-1]

    def mouth(self, left_m: float) -> Float64[np.ndarray, "3"]:
        """Pose at the mouth, looking outward, so far to the left of the middle."""
        return curves.start_pose(self.outward(left_m, 0.0, 1.0))

    def across(self, from_m: float, to_m: float) -> Points:
        """Outline of a band of the road, kerb to kerb, between two distances."""
        left_m = self.outward(self.half_m, from_m, to_m)
        right_m = self.outward(-self.half_m, from_m, to_m)
        return np.array([left_m[0], right_m[0], right_m[-1], left_m[-1]])


def turned_back(pose: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """Turn a pose to look the other way."""
    return pose + np.array([0.0, 0.0, np.pi])
