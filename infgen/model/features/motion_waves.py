"""Waves that describe the ends of motion tokens, from coarse to fine."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

LONGEST_WAVE_M = 64.0
"""Longer than any motion token. Each wave is half as long as the one before it ..."""
WAVES = 9
"""... down to a quarter of a metre."""
TURN_WAVES = 6
"""Waves of the heading, of which each turns twice as fast as the one before it."""


def wave_phases(end_pose: Float[Tensor, "*token 3"]) -> Float[Tensor, "*token wave"]:
    """Phases of poses in waves of either axis and of the heading, in radians."""

    def doubled(count: int) -> Tensor:
        return 2.0 ** torch.arange(count, device=end_pose.device, dtype=end_pose.dtype)

    per_m = 2 * math.pi / LONGEST_WAVE_M * doubled(WAVES)
    x_m, y_m, heading_rad = end_pose[..., None].unbind(-2)
    return torch.cat([x_m * per_m, y_m * per_m, heading_rad * doubled(TURN_WAVES)], dim=-1)
