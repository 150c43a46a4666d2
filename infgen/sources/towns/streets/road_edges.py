"""Where the road ends: road edges around blocks and islands, the road on their left.

Around every junction stand arms, each a street with its two directions or a one-way edge.
The road edge comes in along the right of one arm and goes out along the right of the next
arm counter-clockwise; between the two it rounds the corner.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from infgen.scene import RoadEdgeType
from infgen.sources.towns.streets import curves
from infgen.sources.towns.streets.curves import Points
from infgen.sources.towns.streets.network import Edge, Network, Use

CORNER_SPACING_M = 0.5
OUTWARD_M = 20.0
"""How far from the junction the order of its arms is taken."""
DIRECTION_OVER_M = 5.0
"""Over how much of its end the direction of an arm is taken."""
LEAST_ISLAND_M = 0.5
"""Islands between two directions are at least twice as wide."""


@dataclass(frozen=True, slots=True)
class RoadEdge:
    """One road edge."""

    kind: RoadEdgeType
    xy_m: Points


@dataclass(frozen=True, slots=True)
class _Arm:
    """A street at a junction: its road edge towards the junction, and away from it."""

    coming_m: Points
    going_m: Points


def draw_road_edges(network: Network) -> Iterator[RoadEdge]:
    """Draw all road edges of a town."""
    arms: dict[str, list[_Arm]] = {name: [] for name in network.places_m}
    for edge in network.edges.values():
        back = network.edges.get(reverse_of(edge.name))
        arms[edge.start].append(_arm(edge, back))
        if back is None:
            arms[edge.end].append(_arm(None, edge))
    for around in arms.values():
        if around:
            yield from _corners(_counter_clockwise(around))
    yield from _islands(network)


def reverse_of(edge: str) -> str:
    """Name of the other direction of a street."""
    return edge[:-1] + {"f": "b", "b": "f"}.get(edge[-1], "")


def _arm(going: Edge | None, coming: Edge | None) -> _Arm:
    """Make the arm of an edge that goes out, one that comes in, or both."""
    if going is not None and coming is not None:
        out_m, in_m = going.kerb(), coming.kerb()
    elif going is not None:
        out_m, in_m = going.kerb(), going.middle()[::-1]
    else:
        assert coming is not None
        out_m, in_m = coming.middle()[::-1], coming.kerb()
    return _Arm(in_m, out_m)


def _counter_clockwise(arms: list[_Arm]) -> list[_Arm]:
    """Sort the arms of a junction.

    Where they end may lie on either side of its middle, if streets meet at acute angles:
    what counts is where they come from.
    """
    ends_m = np.array([(arm.going_m[0] + arm.coming_m[-1]) / 2 for arm in arms])
    outward_m = np.array([_outward(arm) for arm in arms]) * OUTWARD_M
    x_m, y_m = (ends_m + outward_m - ends_m.mean(axis=0)).T
    return [arms[at] for at in np.argsort(np.arctan2(y_m, x_m), kind="stable")]


def _outward(arm: _Arm) -> Float64[np.ndarray, "2"]:
    """Return the direction of an arm away from its junction."""
    ends_m = np.array([0.0, DIRECTION_OVER_M])
    sides = (arm.going_m, arm.coming_m[::-1])
    x_m, y_m = sum(np.diff(curves.points_at(side_m, ends_m), axis=0)[0] for side_m in sides)
    return np.array([x_m, y_m]) / np.hypot(x_m, y_m)


def _corners(arms: list[_Arm]) -> Iterator[RoadEdge]:
    """Draw every road edge that comes in, and the corner it rounds."""
    for at, arm in enumerate(arms):
        following = arms[(at + 1) % len(arms)]
        if following is arm:  # The street ends here, and so do its road edges.
            yield RoadEdge(RoadEdgeType.BOUNDARY, arm.coming_m)
            return
        start, end = curves.end_pose(arm.coming_m), curves.start_pose(following.going_m)
        if np.linalg.norm(end[:2] - start[:2]) > CORNER_SPACING_M:
            corner_m = curves.join(start, end, CORNER_SPACING_M)
            yield RoadEdge(RoadEdgeType.BOUNDARY, curves.chain(arm.coming_m, corner_m))
        else:
            yield RoadEdge(RoadEdgeType.BOUNDARY, arm.coming_m)


def _islands(network: Network) -> Iterator[RoadEdge]:
    """Draw the islands between the directions of streets, as closed lines."""
    for edge in network.edges.values():
        back = network.edges.get(reverse_of(edge.name))
        if back is None or edge.name > back.name:
            continue
        if edge.inner.use is Use.NO_USE and edge.inner.width_m > LEAST_ISLAND_M:
            sides_m = [each.inner.border(-each.inner.width_m / 2) for each in (edge, back)]
            outline_m = curves.chain(*(side_m[::-1] for side_m in sides_m))
            yield RoadEdge(RoadEdgeType.MEDIAN, np.concatenate([outline_m, outline_m[:1]]))
