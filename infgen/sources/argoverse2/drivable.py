"""Outlines of drivable areas as road edges, with the road on their left.

Argoverse 2 has no road edges, but polygons of drivable area that touch and overlap one
another, and end where the map was cut out. What bounds all of them together are the road
edges: the parts of their outlines that have no drivable area beyond, and that no lane
crosses (there the map ends, not the road).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

from infgen.sources.open_ends import OpenEnds
from infgen.sources.polylines import (
    arc_length_m,
    densify,
    drop_repeats,
    inside,
    kept_chains,
    signed_area_m2,
)

SPACING_M = 0.5
"""Length of the parts that an outline is judged by."""
BEYOND_M = 0.2
"""How far outside its outline a part looks for other drivable area: wider than the gaps
between polygons that touch."""
MIN_EDGE_M = 1.0
"""Shorter remains of an outline are left out."""

Outline = Float64[np.ndarray, "_ 3"]


def road_edges(
    areas: Sequence[Outline], lanes: Sequence[Outline]
) -> list[Float64[np.ndarray, "_ 3"]]:
    """Return the lines that bound some areas together.

    Args:
        areas: Polygons; corners in any direction, closed or not.
        lanes: Centre lines.

    Returns:
        Lines with the area on their left; closed where they run around.
    """
    rings = [_counter_clockwise(area) for area in areas]
    rings = [ring for ring in rings if len(ring) > 3]
    ends, edges = OpenEnds(lanes), []
    for ring in rings:
        line_m = densify(ring, SPACING_M)
        outside = _outside(line_m, rings)
        kept = outside & ~ends.parts(line_m, outside)
        edges += [
            edge
            for edge in kept_chains(line_m, kept)
            if arc_length_m(edge)[-1] >= MIN_EDGE_M
        ]
    return edges


def _counter_clockwise(area: Outline) -> Outline:
    """Close a polygon and turn it so that it lies on the left of its outline."""
    corners = drop_repeats(area)
    if len(corners) > 1 and (corners[0] == corners[-1]).all():
        corners = corners[:-1]
    if signed_area_m2(corners[:, :2]) < 0:
        corners = corners[::-1]
    return np.concatenate([corners, corners[:1]])


def _outside(line_m: Outline, rings: Sequence[Outline]) -> Bool[np.ndarray, " part"]:
    """Which parts of an outline have no drivable area just beyond them."""
    along_m = np.diff(line_m[:, :2], axis=0)
    length_m = np.maximum(np.linalg.norm(along_m, axis=1, keepdims=True), 1e-9)
    right = np.stack([along_m[:, 1], -along_m[:, 0]], axis=1) / length_m
    beyond_m = (line_m[:-1, :2] + line_m[1:, :2]) / 2 + BEYOND_M * right
    found = np.zeros(len(beyond_m), bool)
    for ring in rings:
        found |= inside(beyond_m, ring[:, :2])
    return ~found
