"""Map samples made by rule: arcs of every length and curvature, where maps show none."""

import numpy as np
from jaxtyping import Float32

from infgen.tokens.map import INTERVALS_PER_MAP_TOKEN, POINTS_PER_MAP_TOKEN
from infgen.tokens.vocabulary import MAP_SPACING_M

MAX_ARC_TURN_RAD = 2.0
"""Turn of the sharpest arc, first interval to last."""


def make_arcs(spacing_m: float) -> Float32[np.ndarray, "map_token 11 2"]:
    """Make arcs, the longest and straightest first.

    Args:
        spacing_m: How far neighbouring arcs' last points are apart, about.
    """
    longest_m = INTERVALS_PER_MAP_TOKEN * MAP_SPACING_M
    lengths = int((longest_m - MAP_SPACING_M) / spacing_m)
    bends = int(MAX_ARC_TURN_RAD / (2 * spacing_m / longest_m))
    length_m = longest_m - np.arange(lengths + 1) * spacing_m
    turn_rad = np.arange(-bends, bends + 1) * (2 * spacing_m / longest_m)
    length_m, turn_rad = (x.ravel() for x in np.meshgrid(length_m, turn_rad))
    effort = np.round((1 - length_m / longest_m) ** 2 + turn_rad**2, 6)
    order = np.lexsort((turn_rad, effort))
    length_m, turn_rad = length_m[order, None], turn_rad[order, None]

    # Eleven points of a polyline of equal chords; the first chord along +x.
    heading_rad = (
        turn_rad * np.arange(INTERVALS_PER_MAP_TOKEN) / (INTERVALS_PER_MAP_TOKEN - 1)
    )
    step_m = np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=-1)
    curve_m = np.zeros((len(order), POINTS_PER_MAP_TOKEN, 2))
    step_m *= length_m[..., None] / INTERVALS_PER_MAP_TOKEN
    curve_m[:, 1:] = np.cumsum(step_m, axis=1)
    return curve_m.astype(np.float32)
