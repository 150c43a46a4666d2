"""Rotary embedding of headings and times.

Features are turned, two numbers at a time, by angles that follow from the heading and the
token step of the agent or map token they belong to. A product of two turned features
depends only on how the two headings, and the two times, differ: on nothing of the frame
that both are given in.
Every angle is a whole multiple of the heading, so that a full turn changes nothing (DRoPE,
arXiv 2503.15029), and a multiple of the time that repeats after ``CYCLE_TOKENS``.

Shape letters as in ``layers``; P the pairs of numbers of a feature, D / 2.
"""

import math
from typing import Any

import torch
from jaxtyping import Complex64, Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

HARMONICS = (0, 0, 0, 0, 1, 1, 2, 1)
"""Multiples of the heading by which consecutive pairs of numbers turn, over and over ..."""
PERIODS_TOKENS = (0, 0, 32, 8, 0, 0, 0, 16)
"""... and token steps after which they have turned once by the time; 0: they never do."""
CYCLE_TOKENS = 32
"""Times repeat after so many token steps: what all periods divide."""


def multiples(width: int) -> Float32[Tensor, "2 pair"]:
    """Return by which multiples of heading and time features of a width are turned.

    The width is even. Made once: what is made of a list on a device makes the host wait.
    """
    pair = torch.arange(width // 2) % len(HARMONICS)
    period = torch.tensor(PERIODS_TOKENS, dtype=torch.float32)
    per_token = torch.where(period > 0, 2 * math.pi / period.clamp(min=1), 0.0)
    return torch.stack([torch.tensor(HARMONICS, dtype=torch.float32), per_token])[:, pair]


@torch.no_grad()
def turn_of(
    pose: Float32[Tensor, "*row 3"],
    of_each: Float32[Tensor, "2 pair"],
    token: Tensor | float = 0.0,
) -> Complex64[Tensor, "*row pair"]:
    """Return by what features are turned, as unit complex numbers.

    Args:
        pose: Poses of those they belong to; only the heading counts.
        of_each: ``multiples`` of their width.
        token: Token step of each, or of all.
    """
    time = token % CYCLE_TOKENS
    time = time[..., None] if isinstance(time, Tensor) else time
    angle_rad = pose[..., 2:] * of_each[0] + time * of_each[1]
    return torch.polar(torch.ones_like(angle_rad), angle_rad)


def turned(features: Tensor, turn: Tensor | None) -> Tensor:
    """Turn features [..., D] by ``turn_of`` [..., P]; None leaves them as they are."""
    if turn is None:
        return features
    found: Tensor = _Turn.apply(features, turn)  # type: ignore[no-untyped-call]
    return found


def turned_back(features: Tensor, turn: Tensor | None) -> Tensor:
    """Inverse of ``turned``."""
    return turned(features, None if turn is None else turn.conj_physical())


def turned_first(
    values_NQE: Tensor, turn_NP: Tensor | None, *, back: bool = False
) -> Tensor:
    """Turn the first numbers of values, those of features, in place; or turn them back."""
    if turn_NP is None:
        return values_NQE
    first, turn = values_NQE[..., : 2 * turn_NP.shape[-1]], turn_NP[:, None]
    turns = turned_back if back else turned
    first.copy_(turns(first.contiguous(), turn))
    return values_NQE


class _Turn(torch.autograd.Function):
    """Autograd would keep the features, though the gradient needs the turn alone."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, turn: Tensor) -> Tensor:
        ctx.save_for_backward(turn)
        return _products(features, turn)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pull: Tensor) -> tuple[Tensor, None]:
        (turn,) = ctx.saved_tensors
        return _products(pull.contiguous(), turn.conj_physical()), None


def _products(features: Tensor, turn: Tensor) -> Tensor:
    """Multiply pairs of numbers, as complex ones, which are of float32 at least."""
    rough = features.dtype.itemsize < torch.float32.itemsize
    full = features.float() if rough else features
    pairs = torch.view_as_complex(full.view(*full.shape[:-1], turn.shape[-1], 2))
    return torch.view_as_real(pairs * turn).view_as(full).to(features.dtype)
