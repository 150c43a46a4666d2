"""What ``rollout.rules`` stands for: a value for every rule over the network's choices."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RuleSet:
    """Values of all rules.

    Attributes:
        max_motion_samples: Samples of one motion token before a collision is accepted; 1
            accepts the first sample.
        reject_off_road: Whether motion tokens that leave the road are rejected too.
        max_stall_s: After so long in a lane a vehicle sets off; 0 for never.
        density_control: Power of the density control; 0 for none.
        insertion_mask: Whether positions of inserted agents are rejected.
        insertion_lane_distance_m: Largest distance from a lane of an inserted vehicle.
        max_insertion_attempts: Samples of one position before the insertion is given up.
    """

    max_motion_samples: int
    reject_off_road: bool
    max_stall_s: float
    density_control: float
    insertion_mask: bool
    insertion_lane_distance_m: float
    max_insertion_attempts: int


RULE_SETS = {
    "none": RuleSet(
        max_motion_samples=1,
        reject_off_road=False,
        max_stall_s=0.0,
        density_control=0.0,
        insertion_mask=False,
        insertion_lane_distance_m=math.inf,
        max_insertion_attempts=1,
    ),
    "safe": RuleSet(
        max_motion_samples=32,
        reject_off_road=True,
        max_stall_s=20.0,
        density_control=1.0,
        insertion_mask=True,
        insertion_lane_distance_m=25.0,
        max_insertion_attempts=16,
    ),
}
"""``none``: what the network samples is simulated, as in the paper. ``safe``: agents avoid
collisions, stay on the road, do not stall, and keep their number (docs/rules.md)."""
