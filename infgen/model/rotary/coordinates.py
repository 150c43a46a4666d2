"""Relative poses as a few coordinates, of which none is learned.

Each of these numbers is a sum of products of a number of the target and one of the source,
whatever frame both are given in: polynomials of first and second order in positions, with
sines and cosines of headings. A score that is linear in them is thus a plain product of
something of the query and something of the key, exactly and at any distance, where phases
of positions (arXiv 2507.18597) are a series cut short whose error grows with the distance
from the origin. Here they are computed pair by pair all the same: the difference of two
positions is then exact to a float far from the origin too.
"""

import torch
from jaxtyping import Float
from torch import Tensor

UNIT_M = 4.0
"""Lengths are in units of this: small enough that fractions of a lane count ..."""
SQUARES_UNIT_M = 15.0
"""... those in products of this, so that those of a whole radius are not too large ..."""
UNIT_TOKENS = 8.0
"""... and time differences of this."""


@torch.no_grad()
def coordinates(
    target_pose: Float[Tensor, "target 3"],
    source_pose: Float[Tensor, "target neighbour 3"],
    ago: Float[Tensor, "target neighbour"] | None = None,
) -> Float[Tensor, "target neighbour 12"]:
    """Describe neighbours to their target.

    Args:
        target_pose: Poses of targets.
        source_pose: Poses of the neighbours of each.
        ago: Token steps since the neighbours' times, negative; None where it is the same.

    Returns:
        Where the source is as the target sees it (forward, left, their squares and their
        product), where the target is as the source sees it (forward, left, the square of
        left: from the tokens of a lane, how far the target is off its centre), the cosine
        and sine of the relative heading, and the time difference with its square.
    """
    away_m = source_pose[..., :2] - target_pose[:, None, :2]
    heading_rad = target_pose[:, None, 2]
    away = (away_m / UNIT_M).unbind(-1)
    ahead, left = _seen_from(heading_rad.cos(), heading_rad.sin(), *away)
    turned_rad = source_pose[..., 2] - heading_rad
    cos, sin = turned_rad.cos(), turned_rad.sin()
    before, beside = _seen_from(cos, sin, -ahead, -left)
    gap = torch.zeros_like(ahead) if ago is None else ago / UNIT_TOKENS
    wide, broad, aside = (
        each * (UNIT_M / SQUARES_UNIT_M) for each in (ahead, left, beside)
    )
    return torch.stack(
        [
            *(ahead, left, wide * wide, broad * broad, wide * broad),
            *(before, beside, aside * aside),
            *(cos, sin, gap, gap * gap),
        ],
        dim=-1,
    )


def _seen_from(cos: Tensor, sin: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Turn vectors to the axes of a heading: forward, left."""
    return cos * x + sin * y, cos * y - sin * x
