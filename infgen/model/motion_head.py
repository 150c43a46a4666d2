"""Motion head: logits of the next motion token from features of where each token leads.

The paper gives each of two thousand moves a logit of its own (SPEC 4.5), each learned
alone: what is seen of one says nothing about the next one, ten centimetres to its left.
Here every motion token has a feature that follows from the pose where it ends, so motion
tokens that lead to nearly the same place share features, so that few scenes teach all of
them.
"""

import math
from functools import partial

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn

from infgen.model.layers import by_agent_type, mlp
from infgen.tokens.vocabulary import MotionVocabulary

LONGEST_WAVE_M = 64.0
"""Longer than any motion token. Each wave is half as long as the one before it ..."""
WAVES = 9
"""... down to a quarter of a metre."""
TURN_WAVES = 6
"""Waves of the heading, of which each turns twice as fast as the one before it."""
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
        waves = torch.from_numpy(_waves(vocabulary.end_pose))
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
    end_pose: Float32[np.ndarray, "3 motion_token 3"],
) -> Float32[np.ndarray, "3 motion_token wave"]:
    """Describe where motion tokens end, from coarse to fine."""
    per_m = 2 * math.pi / LONGEST_WAVE_M * 2.0 ** np.arange(WAVES)
    phase = [end_pose[..., axis, None] * per_m for axis in (0, 1)]
    phase.append(end_pose[..., 2, None] * 2.0 ** np.arange(TURN_WAVES))
    plain = end_pose / np.array([UNIT_M, UNIT_M, 1.0])
    turns = np.concatenate(phase, axis=-1)
    told = np.concatenate([plain, np.cos(turns), np.sin(turns)], axis=-1)
    return told.astype(np.float32)
