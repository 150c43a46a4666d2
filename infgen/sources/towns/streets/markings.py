"""What is painted on the road and set up beside it: lines, crosswalks, stop signs."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float64

from infgen.scene import RoadLineType
from infgen.sources.towns.streets import curves
from infgen.sources.towns.streets.curves import Points
from infgen.sources.towns.streets.network import Crossing, Edge, Lane, Network, Use
from infgen.sources.towns.streets.road_edges import reverse_of
from infgen.sources.towns.streets.street_types import Rank, Street

NARROWEST_PARKING_M = 1.0
"""Narrower strips along the road edge are gutters."""
SIGN_ASIDE_M = 0.7
BUMP_SHARE = 0.4
"""Share of the local streets that have a speed bump."""
STOPPING_STATES = frozenset("sw")
"""SUMO's letters of ways before which one must stand still first."""


@dataclass(frozen=True, slots=True)
class Line:
    """A painted line.

    Attributes:
        kind: How it is painted.
        xy_m: Where.
        left_of: Names of the lanes on whose left it is.
        right_of: Names of the lanes on whose right it is.
    """

    kind: RoadLineType
    xy_m: Points
    left_of: tuple[str, ...]
    right_of: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Sign:
    """A stop sign, and the ways that it speaks to."""

    xy_m: Float64[np.ndarray, "2"]
    connectors: tuple[str, ...]


def draw_lines(network: Network, streets: dict[str, Street]) -> Iterator[Line]:
    """Draw the lines of all streets.

    Args:
        network: The town.
        streets: The street of each edge; edges without one have no lines.
    """
    for name, street in streets.items():
        edge = network.edges[name]
        yield from _between_lanes(edge)
        back = network.edges.get(reverse_of(name))
        if edge.inner.use is Use.NO_USE:
            xy_m = edge.driven[-1].border(edge.driven[-1].width_m / 2)
            inner = (edge.driven[-1].name,)
            yield Line(RoadLineType.SOLID_SINGLE_YELLOW, xy_m, inner, ())
        elif back is not None and name < back.name and street.lined:
            lanes = (edge.driven[-1].name, back.driven[-1].name)
            yield Line(_middle_kind(street), edge.middle(), lanes, ())


def _middle_kind(street: Street) -> RoadLineType:
    if street.num_lanes > 1:
        return RoadLineType.SOLID_DOUBLE_YELLOW
    if street.rank is Rank.COLLECTOR and street.limit_mph > 27:
        return RoadLineType.SOLID_SINGLE_YELLOW
    return RoadLineType.BROKEN_SINGLE_YELLOW


def _between_lanes(edge: Edge) -> Iterator[Line]:
    """Draw the lines along the right of lanes: to the next lane, or to parked cars."""
    lanes = [lane for lane in edge.lanes if lane.use is not Use.WALKERS]
    for right, left in pairwise(lanes):
        if not left.driven or _nothing_between(right, left):
            continue
        broken = left.use is right.use
        kind = (
            RoadLineType.BROKEN_SINGLE_WHITE if broken else RoadLineType.SOLID_SINGLE_WHITE
        )
        beside = (right.name,) if right.driven else ()
        yield Line(kind, left.border(-left.width_m / 2), beside, (left.name,))


def _nothing_between(right: Lane, left: Lane) -> bool:
    """Whether no line is painted: towards a gutter, and where parking lots cars as well."""
    gutter = right.width_m < NARROWEST_PARKING_M
    return right.use is Use.NO_USE and (gutter or left.use is Use.DRIVERS)


def draw_crosswalks(
    network: Network, rng: np.random.Generator
) -> list[Float64[np.ndarray, "4 2"]]:
    """Draw outlines of the crossings that are painted: all at lights, some elsewhere."""
    shares = {"traffic_light": 1.0, "allway_stop": 0.6, "priority_stop": 0.2}
    painted = {
        name: rng.random() < shares.get(rule, 0.25) for name, rule in network.rules.items()
    }
    return [_outline(each) for each in network.crossings if painted[each.junction]]


def _outline(crossing: Crossing) -> Float64[np.ndarray, "4 2"]:
    ends_m = crossing.xy_m[[0, -1]]
    along_m = ends_m[1] - ends_m[0]
    left = np.array([-along_m[1], along_m[0]]) / max(float(np.linalg.norm(along_m)), 1e-6)
    half_m = crossing.width_m / 2 * left
    return np.concatenate([ends_m + half_m, (ends_m - half_m)[::-1]])


def draw_bumps(
    network: Network, streets: dict[str, Street], rng: np.random.Generator
) -> list[Float64[np.ndarray, "4 2"]]:
    """Lay a speed bump across some slow streets of two directions, from lane to lane."""
    made = []
    for name, street in streets.items():
        back = reverse_of(name)
        slow = street.rank is Rank.LOCAL and name < back
        if not slow or back not in streets or rng.random() > BUMP_SHARE:
            continue
        sides_m = [
            network.edges[each].driven[0].border(-street.lane_m / 2)
            for each in (name, back)
        ]
        middle = len(sides_m[0]) // 2
        along_m = sides_m[0][middle]
        opposite = int(np.linalg.norm(sides_m[1] - along_m, axis=1).argmin())
        if 2 <= middle < len(sides_m[0]) - 2 and 1 <= opposite < len(sides_m[1]) - 1:
            # Points are about two metres apart: a bump is one such step long.
            near_m, far_m = sides_m[0][middle : middle + 2], sides_m[1][opposite - 1 :][:2]
            made.append(np.concatenate([near_m, far_m]))
    return made


def draw_signs(network: Network) -> Iterator[Sign]:
    """Put a stop sign beside the end of every edge whose traffic must stop."""
    stopping: dict[str, list[str]] = {}
    for each in network.connectors:
        if each.state in STOPPING_STATES and network.lanes[each.start].use is Use.DRIVERS:
            stopping.setdefault(network.edge_of[each.start].name, []).append(each.name)
    for name, connectors in stopping.items():
        kerb_m = network.edges[name].kerb()
        aside_m = curves.offset(kerb_m[-2:], -SIGN_ASIDE_M)
        yield Sign(aside_m[-1], tuple(connectors))
