"""The part of a network that stands where it has an embedding of relations otherwise."""

import torch
from torch import Tensor, nn

from infgen.model.rotary.turns import multiples, turn_of


class RotaryRelation(nn.Module):
    """Relative poses by turns of features and by coordinates: nothing is learned here."""

    of_each: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("of_each", multiples(width), persistent=False)

    def table(self) -> Tensor:
        """Return an empty table: there is nothing to look up."""
        return torch.empty(0)

    def turn(self, pose: Tensor, token: Tensor | float = 0.0) -> Tensor:
        """Return by what the features of poses [..., 3] at token steps are turned."""
        turn: Tensor = turn_of(pose, self.of_each, token)
        return turn
