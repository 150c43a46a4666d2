"""Who comes near: what others around an agent do, as that agent sees it.

Attention adds up what stands in the relation of a pair (where the other one is) and in the
features of the other agent (how it moves). Whether two agents meet is neither of the two,
but a product of both: it depends on the velocity of the one relative to the place of the
other. So pairs are described by both together, through an MLP of their own, and what stands
out among all pairs of an agent (the maximum of each feature) is added to its features.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor, nn

from infgen.model.layers import begin_last_at_zero, mlp

PAIR_WIDTH = 32
"""Width of the features of a pair."""
AWAY_M, STEP_M, SIZE_M = 20.0, 5.0, 5.0
"""Units of places, of displacements in a token step (10 m/s), and of boxes ..."""
MOST_UNITS = 3.0
"""... and the most of them that are told apart."""
NEAR_M = 5.0
"""Distance in which nearness falls to 1 / e."""
MEETING_TOKENS = 8.0
"""Token steps within which two agents may come closest (4 s)."""
INPUTS = 14


@dataclass(frozen=True, slots=True)
class MovingPairs:
    """Agents, how they moved in the last token step, and the others around each.

    Attributes:
        pose: Poses.
        step_m: Displacements in the last token step; zero where they are not known ...
        known: ... and where they are.
        size_lw_m: Boxes.
        index: Rows of the agents around each ...
        present: ... and which of them there are.
    """

    pose: Float32[Tensor, "row 3"]
    step_m: Float32[Tensor, "row 2"]
    known: Bool[Tensor, " row"]
    size_lw_m: Float32[Tensor, "row 2"]
    index: Int64[Tensor, "row neighbour"]
    present: Bool[Tensor, "row neighbour"]

    def inputs(self) -> Float32[Tensor, "row neighbour input"]:
        """Describe pairs in the frames of their first agents, in units."""
        cos, sin = self.pose[:, 2].cos(), self.pose[:, 2].sin()

        def local(x_m: Tensor, y_m: Tensor) -> tuple[Tensor, Tensor]:
            return cos[:, None] * x_m + sin[:, None] * y_m, (
                cos[:, None] * y_m - sin[:, None] * x_m
            )

        other, their_step_m = self.pose[self.index], self.step_m[self.index]
        x_m, y_m = local(*(other - self.pose[:, None])[..., :2].unbind(-1))
        step_m = self.step_m[:, None]
        to_x_m, to_y_m = local(*(their_step_m - step_m).unbind(-1))
        ahead_m, aside_m = local(*step_m.expand_as(their_step_m).unbind(-1))
        turned_rad = other[..., 2] - self.pose[:, None, 2]
        square_m2 = to_x_m * to_x_m + to_y_m * to_y_m
        tokens = -(x_m * to_x_m + y_m * to_y_m) / square_m2.clamp(min=1e-2)
        tokens = tokens.clamp(0.0, MEETING_TOKENS)
        away_m = (x_m * x_m + y_m * y_m).sqrt()
        closest_x_m, closest_y_m = x_m + tokens * to_x_m, y_m + tokens * to_y_m
        closest_m = (closest_x_m * closest_x_m + closest_y_m * closest_y_m).sqrt()
        sizes_m = self.size_lw_m[:, None] + self.size_lw_m[self.index]
        length_m, width_m = sizes_m.unbind(-1)
        units = [
            *(each / AWAY_M for each in (x_m, y_m)),
            *(each / STEP_M for each in (to_x_m, to_y_m, ahead_m, aside_m)),
            *(each / (2 * SIZE_M) for each in (length_m, width_m)),
        ]
        told = [
            *(each.clamp(-MOST_UNITS, MOST_UNITS) for each in units),
            turned_rad.cos(),
            turned_rad.sin(),
            tokens / MEETING_TOKENS,
            (-closest_m / NEAR_M).exp(),
            (-away_m / NEAR_M).exp(),
            (-away_m / AWAY_M).exp(),
        ]
        return torch.stack(told, dim=-1)


class ApproachFeatures(nn.Module):
    """What stands out among the pairs of every agent."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.pairs = nn.Sequential(
            nn.Linear(INPUTS, PAIR_WIDTH),
            nn.ReLU(),
            nn.Linear(PAIR_WIDTH, PAIR_WIDTH),
            nn.ReLU(),
        )
        self.embed = mlp(PAIR_WIDTH, width, width)

    def begin_at_zero(self) -> None:
        """Let the features be zero at first."""
        begin_last_at_zero(self.embed)

    def forward(self, moving: MovingPairs) -> Tensor:
        """Describe who comes near to agents [row, width]; pairs count where they are."""
        if not moving.index.shape[1]:
            most = moving.pose.new_zeros((len(moving.pose), PAIR_WIDTH))
        else:
            pairs = self.pairs(moving.inputs()) * moving.present[..., None]
            most = pairs.amax(dim=1)  # None is below zero: where there is no pair, zero.
        embedded: Tensor = self.embed(most)
        return embedded
