"""Rotary embedding of headings and times.

Features are turned, two numbers at a time, by angles that follow from the heading and the
token step of whoever they belong to. A product of two turned features depends only on how
the two headings, and the two times, differ: on nothing of the frame that both are given in.
Every angle is a whole multiple of the heading, so that a full turn changes nothing (DRoPE,
arXiv 2503.15029), and a multiple of the time that repeats after ``CYCLE_TOKENS``.

Shape letters as in ``layers``; P the pairs of numbers of a feature, D / 2.
"""

import math

import torch
from jaxtyping import Complex64, Float32
from torch import Tensor

HARMONICS = (0, 0, 0, 0, 1, 1, 2, 1)
"""Multiples of the heading by which consecutive pairs of numbers turn, over and over ..."""
PERIODS_TOKENS = (0, 0, 32, 8, 0, 0, 0, 16)
"""... and token steps after which they have turned once by the time; 0: they never do."""
CYCLE_TOKENS = 32
"""Times repeat after so many token steps: what all periods divide."""


@torch.no_grad()
def turn_of(
    pose: Float32[Tensor, "*row 3"], width: int, token: Tensor | float = 0.0
) -> Complex64[Tensor, "*row pair"]:
    """Return by what features of so many numbers are turned, as unit complex numbers.

    Args:
        pose: Poses of those they belong to; only the heading counts.
        width: Numbers of a feature; even.
        token: Token step of each, or of all.
    """
    pair = torch.arange(width // 2, device=pose.device) % len(HARMONICS)
    harmonic = pose.new_tensor(HARMONICS)[pair]
    period = pose.new_tensor(PERIODS_TOKENS)[pair]
    per_token = torch.where(period > 0, 2 * math.pi / period.clamp(min=1), 0.0)
    time = torch.as_tensor(token, dtype=pose.dtype, device=pose.device) % CYCLE_TOKENS
    angle_rad = pose[..., 2:] * harmonic + time[..., None] * per_token
    return torch.polar(torch.ones_like(angle_rad), angle_rad)


def turned(features: Tensor, turn: Tensor | None) -> Tensor:
    """Turn features [..., D] by ``turn_of`` [..., P]; None leaves them as they are."""
    if turn is None:
        return features
    pairs = torch.view_as_complex(
        _full(features).view(*features.shape[:-1], turn.shape[-1], 2)
    )
    return torch.view_as_real(pairs * turn).view_as(features).to(features.dtype)


def turned_back(features: Tensor, turn: Tensor | None) -> Tensor:
    """Inverse of ``turned``."""
    return turned(features, None if turn is None else turn.conj())


def _full(features: Tensor) -> Tensor:
    """Complex numbers are of float32 at least."""
    return (
        features.float() if features.dtype.itemsize < torch.float32.itemsize else features
    )
