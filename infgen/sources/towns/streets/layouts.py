"""Layouts: a skeleton with a kind of street on every link and a rule at every node."""

from dataclasses import dataclass, replace
from enum import Enum
from itertools import combinations

import numpy as np
from jaxtyping import Float64, Int64

from infgen.sources.towns.streets.one_way import draw_one_way
from infgen.sources.towns.streets.street_types import (
    CURB_M,
    Rank,
    Street,
    draw_street,
)
from infgen.sources.towns.streets.topology import Skeleton
from infgen.sources.towns.variety import BASIC, StreetVariety

_STRAIGHT_RAD = np.deg2rad(38.0)
"""Links that meet at a flatter bend are one street."""
_SHARES = ((0.18, Rank.ARTERIAL), (0.5, Rank.COLLECTOR), (1.0, Rank.LOCAL))
"""Ranks of streets, the longest first: up to this share of them."""
ROUNDABOUT_M = (14.0, 18.0)
_ROUNDABOUT_RAD = np.deg2rad(62.0)
"""Arms of a roundabout are at least so far apart."""


class Control(Enum):
    """Who goes first at a node. Values are SUMO's types of nodes."""

    SIGNALS = "traffic_light"
    ALL_STOP = "allway_stop"
    MINOR_STOPS = "priority_stop"
    ROUNDABOUT = "roundabout"
    NONE = "priority"
    END = "dead_end"


_DRAWN = tuple(Control)[:5]
_LEAST_LIKING, _LIKING_SHAPE = 0.1, 0.7
"""Where controls are mixed, a town's liking of each is gamma-distributed, and never 0."""
_SHARES_OF_RULES = {
    (Rank.ARTERIAL, Rank.ARTERIAL): (1.0, 0.0, 0.0, 0.0, 0.0),
    (Rank.ARTERIAL, Rank.COLLECTOR): (0.45, 0.0, 0.55, 0.0, 0.0),
    (Rank.ARTERIAL, Rank.LOCAL): (0.06, 0.0, 0.94, 0.0, 0.0),
    (Rank.COLLECTOR, Rank.COLLECTOR): (0.18, 0.18, 0.49, 0.15, 0.0),
    (Rank.COLLECTOR, Rank.LOCAL): (0.03, 0.07, 0.7, 0.08, 0.12),
    (Rank.LOCAL, Rank.LOCAL): (0.0, 0.15, 0.45, 0.1, 0.3),
}
"""Shares of the rules where streets of two ranks meet, in the order of ``Control``."""


@dataclass(frozen=True, slots=True)
class Layout:
    """What netconvert makes a net of.

    Attributes:
        skeleton: Nodes and links.
        street: Of each link.
        one_way: Of each link: 0 for both directions, 1 for that of its nodes alone, -1 for
            the other alone.
        bend: How far each link bulges to its left, as a share of its length.
        control: Of each node.
        ring_m: Radius of each node's roundabout; 0 where there is none.
    """

    skeleton: Skeleton
    street: tuple[Street, ...]
    one_way: Int64[np.ndarray, " link"]
    bend: Float64[np.ndarray, " link"]
    control: tuple[Control, ...]
    ring_m: Float64[np.ndarray, " node"]


def draw_layout(
    skeleton: Skeleton, rng: np.random.Generator, variety: StreetVariety = BASIC.streets
) -> Layout:
    """Draw streets, bends and rules for a skeleton."""
    street_of = _strokes(skeleton)
    street = _streets(skeleton, street_of, variety, rng)
    one_way = np.zeros(len(street), np.int64)
    if variety.one_way:
        minor = np.array([each.rank < Rank.ARTERIAL for each in street])
        one_way = draw_one_way(skeleton, street_of, minor, variety.one_way, rng)
    # The median of a one-way street is the gutter on its left.
    street = tuple(
        replace(each, median_m=CURB_M) if way else each
        for each, way in zip(street, one_way.tolist(), strict=True)
    )
    spread, most = variety.bend
    bend = np.clip(rng.normal(0.0, spread, len(skeleton.link)), -most, most)
    bend *= rng.random(len(bend)) < rng.choice([0.2, 0.7])
    # A way out that swerves might meet another.
    bend[(skeleton.degree[skeleton.link] == 1).any(axis=1)] = 0.0
    liking = np.ones(len(_DRAWN))
    if variety.mixed_controls:
        liking = _LEAST_LIKING + rng.gamma(_LIKING_SHAPE, size=len(_DRAWN))
    control = tuple(
        _control(skeleton, street, node, liking, rng) for node in range(len(skeleton.xy_m))
    )
    round_ = np.array([each is Control.ROUNDABOUT for each in control])
    ring_m = np.where(round_, rng.uniform(*ROUNDABOUT_M, len(control)), 0.0)
    return Layout(skeleton, street, one_way, bend, control, ring_m)


def _streets(
    skeleton: Skeleton,
    street_of: Int64[np.ndarray, " link"],
    variety: StreetVariety,
    rng: np.random.Generator,
) -> tuple[Street, ...]:
    """Give links that go straight on into each other one street, long ones a high rank."""
    ends_m = skeleton.xy_m[skeleton.link]
    length_m = np.linalg.norm(ends_m[:, 1] - ends_m[:, 0], axis=1)
    names, number = np.unique(street_of, return_inverse=True)
    total_m = np.bincount(number, weights=length_m)
    weight = total_m * rng.uniform(0.5, 1.0, len(names))
    place = np.empty(len(names))
    place[np.argsort(-weight, kind="stable")] = (np.arange(len(names)) + 0.5) / len(names)
    shares, ranks = [share for share, _ in _SHARES], [rank for _, rank in _SHARES]
    streets = [
        draw_street(ranks[int(np.searchsorted(shares, at))], rng, variety) for at in place
    ]
    return tuple(streets[at] for at in number.tolist())


def _strokes(skeleton: Skeleton) -> Int64[np.ndarray, " link"]:
    """Number the links so that those which go straight on into each other agree."""
    leader = np.arange(len(skeleton.link))
    for node in range(len(skeleton.xy_m)):
        links = np.flatnonzero((skeleton.link == node).any(axis=1)).tolist()
        away = {at: _bearing(skeleton, at, node) for at in links}
        bends = sorted((_bend(away[a], away[b]), a, b) for a, b in combinations(links, 2))
        free = set(links)
        for bend_rad, one, other in bends:
            if bend_rad < _STRAIGHT_RAD and {one, other} <= free:
                free -= {one, other}
                leader[leader == leader[other]] = leader[one]
    return leader


def _bearing(skeleton: Skeleton, link: int, node: int) -> float:
    """Direction in which a link leaves a node."""
    one, other = skeleton.link[link].tolist()
    x_m, y_m = skeleton.xy_m[other if node == one else one] - skeleton.xy_m[node]
    return float(np.arctan2(y_m, x_m))


def _bend(one_rad: float, other_rad: float) -> float:
    """How far one has to turn from one arm into the other."""
    apart_rad = abs((one_rad - other_rad + np.pi) % (2 * np.pi) - np.pi)
    return float(np.pi - apart_rad)


def _control(
    skeleton: Skeleton,
    street: tuple[Street, ...],
    node: int,
    liking: Float64[np.ndarray, " control"],
    rng: np.random.Generator,
) -> Control:
    """Draw who goes first at a node, by the ranks of the streets that meet there."""
    links = np.flatnonzero((skeleton.link == node).any(axis=1)).tolist()
    if len(links) < 3:
        return Control.END if len(links) == 1 else Control.NONE
    ranks = sorted((street[link].rank for link in links), reverse=True)
    crossing = ranks[2]  # Two arms at most are of the main street.
    shares = liking * _SHARES_OF_RULES[ranks[0], crossing]
    chosen = _DRAWN[rng.choice(len(_DRAWN), p=shares / shares.sum())]
    if chosen is Control.ROUNDABOUT and not _has_room(skeleton, street, node, links):
        return Control.ALL_STOP
    return chosen


def _has_room(
    skeleton: Skeleton, street: tuple[Street, ...], node: int, links: list[int]
) -> bool:
    """Whether a roundabout fits: narrow arms, well apart, and long enough."""
    bearings_rad = np.sort([_bearing(skeleton, link, node) for link in links])
    gaps_rad = np.diff(np.append(bearings_rad, bearings_rad[0] + 2 * np.pi))
    ends_m = skeleton.xy_m[skeleton.link[links]]
    lengths_m = np.linalg.norm(ends_m[:, 1] - ends_m[:, 0], axis=1)
    widest_m = max(street[link].half_m for link in links)
    narrow = all(street[link].num_lanes == 1 for link in links) and widest_m < 6.5
    return bool(narrow and gaps_rad.min() > _ROUNDABOUT_RAD and lengths_m.min() > 60.0)
