"""Where an agent is to the ego, for the removal of agents.

A log loses sight of an agent at the edge of what the ego sees, and hardly ever near the
ego. The embedding of an agent has its cell, but what is left of that after the motion stack
is what motion needs. So removal is told the place anew.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32
from torch import Tensor, nn

from infgen.model.layers import begin_last_at_zero, mlp
from infgen.model.relations import direction

WAVES = 6
"""Waves of the distance to the ego, of which the longest is twice the radius long."""
UNIT_M = 10.0
"""Distances covered in one token step are scaled by this."""
MAX_UNITS = 3.0
"""Longer ones (60 m/s) are seen as this long: an ego and an agent that meet."""
INPUTS = 2 * WAVES + 5


@dataclass(frozen=True, slots=True)
class EgoPlace:
    """Where agents are to the ego of their scene, now and one token step earlier.

    Attributes:
        pose: Poses of the agents.
        ego_pose: Poses of the egos.
        before: Poses of the agents one token step earlier ...
        ego_before: ... and of the egos.
        known: Whether the agents were seen then.
    """

    pose: Float32[Tensor, "row 3"]
    ego_pose: Float32[Tensor, "row 3"]
    before: Float32[Tensor, "row 3"]
    ego_before: Float32[Tensor, "row 3"]
    known: Bool[Tensor, " row"]


class RemovalFeatures(nn.Module):
    """Distance and direction of agents from the ego, and whether they come nearer."""

    def __init__(self, width: int, radius_m: float) -> None:
        super().__init__()
        self.radius_m = radius_m
        self.embed = mlp(INPUTS, width, width)

    def begin_at_zero(self) -> None:
        """Let the features be zero at first."""
        begin_last_at_zero(self.embed)

    def forward(self, place: EgoPlace) -> Tensor:
        """Describe where agents are [row, width]."""
        away_m = place.pose[:, :2] - place.ego_pose[:, :2]
        far_m = _length(away_m)
        before_m = _length(place.before[:, :2] - place.ego_before[:, :2])
        receding = ((far_m - before_m) / UNIT_M).clamp(-MAX_UNITS, MAX_UNITS)
        share = (far_m / self.radius_m).clamp(max=2.0)
        wave = torch.arange(1, WAVES + 1, device=share.device)
        phase = math.pi * share[:, None] * wave
        bearing_rad = direction(away_m, place.ego_pose[:, 2])
        told = [
            share,
            torch.where(place.known, receding, 0.0),
            place.known.to(share.dtype),
            bearing_rad.cos(),
            bearing_rad.sin(),
        ]
        inputs = torch.cat([phase.cos(), phase.sin(), torch.stack(told, dim=-1)], dim=-1)
        embedded: Tensor = self.embed(inputs)
        return embedded


def _length(away_m: Tensor) -> Tensor:
    return away_m.square().sum(dim=-1).sqrt()
