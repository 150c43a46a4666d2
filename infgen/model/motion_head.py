"""Motion head: logits of the next motion token from features of where each token leads.

The paper gives each of two thousand moves a logit of its own (SPEC 4.5), each learned
alone: what is seen of one says nothing about the next one, ten centimetres to its left.
Here every motion token has a feature that follows from the pose where it ends, so motion
tokens that lead to nearly the same place share features, so that few scenes teach all of
them.
"""

from functools import partial

import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor, nn

from infgen.model.features.motion_waves import wave_phases
from infgen.model.layers import by_agent_type, mlp
from infgen.tokens.vocabulary import MotionVocabulary

UNIT_M = 10.0
"""Lengths are scaled to tens of metres, to match the size of the waves."""


class MotionHead(nn.Module):
    """Logits of every agent type's motion tokens, from their shapes.

    Shape letters as in ``layers``; C is the width of the motion tokens' features.
    """

    waves: Tensor

    def __init__(
        self, width: int, motion_feature_width: int, vocabulary: MotionVocabulary
    ) -> None:
        super().__init__()
        waves = _waves(torch.from_numpy(vocabulary.end_pose).double())
        self.register_buffer("waves", waves, persistent=False)
        self.shape = nn.Sequential(
            nn.Linear(waves.shape[-1], 2 * motion_feature_width),
            nn.ReLU(),
            nn.Linear(2 * motion_feature_width, motion_feature_width),
        )
        self.wanted = mlp(width, width, motion_feature_width)
        self.usual = nn.Parameter(torch.zeros(waves.shape[:2]))

    def table(self) -> Tensor:
        """Features [3, motion_token, C] of all motion tokens; no scene changes them."""
        shapes: Tensor = self.shape(self.waves)
        return shapes

    def forward(
        self, x_ND: Tensor, agent_type: Int64[Tensor, " row"], shapes: Tensor
    ) -> Tensor:
        """Logits [N, motion_token] of agents, by their features and those of ``table``."""

        def product(shape: Tensor, usual: Tensor, wanted: Tensor) -> Tensor:
            kind = wanted.dtype
            return torch.addmm(usual.to(kind), wanted, shape.to(kind).T)

        products = [
            partial(product, *each) for each in zip(shapes, self.usual, strict=True)
        ]
        return by_agent_type(self.wanted(x_ND), agent_type, products)


def _waves(
    end_pose: Float64[Tensor, "3 motion_token 3"],
) -> Float32[Tensor, "3 motion_token wave"]:
    """Describe where motion tokens end, from coarse to fine."""
    phase = wave_phases(end_pose)
    plain = end_pose / torch.tensor([UNIT_M, UNIT_M, 1.0], dtype=torch.float64)
    return torch.cat([plain, phase.cos(), phase.sin()], dim=-1).float()
