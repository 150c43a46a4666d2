"""Which way lanes lead at the cells of an ego's grid: away from it, towards it, or past it.

Agents that enter a log where the ego sees no farther come towards it, or are overtaken: who
drives away from the ego has been in its sight before. Attention and features of cells know
the heading of a lane and the place of a cell, one by one; what counts here is the heading
against the direction in which the cell lies.

Shape letters as in ``layers``.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32
from torch import Tensor, nn

from infgen.model.neighbours import MapFeatures, grid_place

WAYS = 3
"""Away from the ego, towards it, past it."""


@dataclass(frozen=True, slots=True)
class LanesAround:
    """Segments of the lanes of the maps [N] of queries.

    Attributes:
        middle_m: Their middles in the world.
        along_m: From where each begins to its end.
        present: Which of them there are.
    """

    middle_m: Float32[Tensor, "query segment 2"]
    along_m: Float32[Tensor, "query segment 2"]
    present: Bool[Tensor, "query segment"]

    @classmethod
    def of(cls, roads: MapFeatures, scene: Tensor) -> "LanesAround | None":
        """Take those of encoded maps; None if these have none."""
        lanes = roads.lanes
        if lanes is None:
            return None
        start_m, along_m = lanes.start_m[scene], lanes.along_m[scene]
        return cls(start_m + along_m / 2, along_m, lanes.real[scene])


class LaneDirections(nn.Module):
    """What lanes add to the features that cells are refined by."""

    def __init__(self, refinement_width: int) -> None:
        super().__init__()
        self.say = nn.Conv2d(WAYS, refinement_width, 3, padding=1, bias=False)

    def begin_at_zero(self) -> None:
        """Change no logit until it is trained."""
        nn.init.zeros_(self.say.weight)

    def forward(self, laid: Float32[Tensor, "query way side side"]) -> Tensor:
        """Say what ways that lie on the lattice add to its points: [N, C, side, side]."""
        said: Tensor = self.say(laid)
        return said


@torch.no_grad()
def ways_of_lanes(
    ego_pose: Float32[Tensor, "query 3"], lanes: LanesAround
) -> tuple[Float32[Tensor, "query segment 2"], Float32[Tensor, "query segment way"]]:
    """Tell where segments are in the egos' grid frame, and which ways they lead.

    The ways of a segment are how much of it leads away from the ego, towards it and past
    it: cosines and a sine of its heading to the direction in which it lies.
    """
    xy_m = grid_place(lanes.middle_m, ego_pose[:, None])
    away = lanes.middle_m - ego_pose[:, None, :2]
    away = away / away.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    along = lanes.along_m / lanes.along_m.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    out = (along * away).sum(dim=-1)
    past = (along[..., 0] * away[..., 1] - along[..., 1] * away[..., 0]).abs()
    return xy_m, torch.stack([out.clamp(min=0), (-out).clamp(min=0), past], dim=-1)
