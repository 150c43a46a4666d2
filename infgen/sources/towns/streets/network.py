"""A town's net as netconvert wrote it: edges, lanes, ways across junctions, signals."""

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float64

from infgen.sources.towns.streets import curves
from infgen.sources.towns.streets.curves import Points


class Use(Enum):
    """Who goes on a lane."""

    NO_USE = "none"
    WALKERS = "walkers"
    CYCLISTS = "cyclists"
    DRIVERS = "drivers"


_USES = {"pedestrian": Use.WALKERS, "bicycle": Use.CYCLISTS}
"""Uses of lanes that are for one kind of road user alone."""


@dataclass(frozen=True, slots=True)
class Lane:
    """A lane of an edge.

    Attributes:
        name: SUMO's id.
        use: Who it is for.
        cycled: Whether cyclists may use it.
        limit_mps: Speed limit.
        width_m: From border to border.
        xy_m: Its middle, in the direction of travel.
    """

    name: str
    use: Use
    cycled: bool
    limit_mps: float
    width_m: float
    xy_m: Points

    @property
    def driven(self) -> bool:
        """Whether it is a lane of the map."""
        return self.use in (Use.DRIVERS, Use.CYCLISTS)

    def border(self, left_m: float) -> Points:
        """Draw a parallel: half its width to the left is its left border."""
        return curves.offset(curves.resample(self.xy_m, 2.0), left_m)


@dataclass(frozen=True, slots=True)
class Edge:
    """One direction of a street between two junctions.

    Attributes:
        name: SUMO's id.
        start: Junction it comes from.
        end: Junction it leads to.
        rank: Its priority.
        lanes: From right to left.
    """

    name: str
    start: str
    end: str
    rank: int
    lanes: tuple[Lane, ...]

    @property
    def inner(self) -> Lane:
        """The leftmost lane."""
        return self.lanes[-1]

    @property
    def outer(self) -> Lane:
        """The rightmost lane within the road edges."""
        return next(lane for lane in self.lanes if lane.use is not Use.WALKERS)

    @property
    def driven(self) -> tuple[Lane, ...]:
        """The lanes of the map, from right to left."""
        return tuple(lane for lane in self.lanes if lane.driven)

    def kerb(self) -> Points:
        """Draw the road edge on the right."""
        return self.outer.border(-self.outer.width_m / 2)

    def middle(self) -> Points:
        """Draw the left border: the middle of the street, if it has two directions."""
        return self.inner.border(self.inner.width_m / 2)

    @property
    def half_m(self) -> float:
        """From the left border to the road edge."""
        return sum(lane.width_m for lane in self.lanes if lane.use is not Use.WALKERS)


@dataclass(frozen=True, slots=True)
class Connector:
    """A way across a junction, from one lane to another.

    Attributes:
        name: SUMO's id of its first part.
        start: Name of the lane it comes from.
        end: Name of the lane it leads to.
        junction: Where it is.
        xy_m: Its middle.
        limit_mps: Speed limit.
        turn: SUMO's letter: s, l, r, L, R or t.
        state: SUMO's letter of who goes first: M, m, =, s, w, o, ...
        signal: Name of the traffic light, or none.
        index: Position in the states of the light.
    """

    name: str
    start: str
    end: str
    junction: str
    xy_m: Points
    limit_mps: float
    turn: str
    state: str
    signal: str
    index: int


@dataclass(frozen=True, slots=True)
class Crossing:
    """A way for walkers across a street.

    Attributes:
        junction: Where it is.
        xy_m: Its middle, from road edge to road edge.
        width_m: Across the walkers' way.
        edges: Names of the edges it crosses.
    """

    junction: str
    xy_m: Points
    width_m: float
    edges: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """What a traffic light shows, over and over again.

    Attributes:
        ends_s: When each phase ends, from the start of the cycle.
        states: Letters of all links in each phase.
        offset_s: When the cycle begins.
    """

    ends_s: Float64[np.ndarray, " phase"]
    states: tuple[str, ...]
    offset_s: float

    def shown(self, time_s: float) -> str:
        """Return the letters shown at a time."""
        within_s = (time_s - self.offset_s) % self.ends_s[-1]
        return self.states[int(np.searchsorted(self.ends_s, within_s, side="right"))]


@dataclass(frozen=True)
class Network:
    """All that netconvert made.

    Attributes:
        edges: Streets, by name.
        connectors: Ways across junctions for drivers and cyclists.
        crossings: Ways across streets for walkers.
        signals: Traffic lights by name.
        rules: SUMO's type of each junction by name.
        places_m: Position of each junction by name.
    """

    edges: dict[str, Edge]
    connectors: tuple[Connector, ...]
    crossings: tuple[Crossing, ...]
    signals: dict[str, SignalPlan]
    rules: dict[str, str]
    places_m: dict[str, tuple[float, float]]

    @cached_property
    def lanes(self) -> dict[str, Lane]:
        """Lanes of the map by name."""
        return {lane.name: lane for edge in self.edges.values() for lane in edge.driven}

    @cached_property
    def edge_of(self) -> dict[str, Edge]:
        """The edge of each lane of the map."""
        return {lane.name: edge for edge in self.edges.values() for lane in edge.driven}

    @cached_property
    def ends(self) -> frozenset[str]:
        """Junctions where a street begins or ends at the rim of the town."""
        return frozenset(name for name, rule in self.rules.items() if rule == "dead_end")


def read_network(path: Path) -> Network:
    """Read a net file of SUMO."""
    root = ElementTree.parse(path).getroot()
    plain: dict[str, Edge] = {}
    inside: dict[str, Element] = {}
    crossings = []
    for element in root.iter("edge"):
        function = element.get("function", "normal")
        if function == "normal":
            plain[element.attrib["id"]] = _edge(element)
        elif function == "internal":
            inside |= {each.attrib["id"]: each for each in element.iter("lane")}
        elif function == "crossing":
            crossings.append(_crossing(element))
    junctions = [
        each for each in root.iter("junction") if each.attrib["type"] != "internal"
    ]
    return Network(
        edges=plain,
        connectors=_connectors(root, plain, inside),
        crossings=tuple(crossings),
        signals={each.attrib["id"]: _plan(each) for each in root.iter("tlLogic")},
        rules={each.attrib["id"]: each.attrib["type"] for each in junctions},
        places_m={
            each.attrib["id"]: (float(each.attrib["x"]), float(each.attrib["y"]))
            for each in junctions
        },
    )


def _edge(element: Element) -> Edge:
    lanes = sorted(element.iter("lane"), key=lambda each: int(each.attrib["index"]))
    return Edge(
        name=element.attrib["id"],
        start=element.attrib["from"],
        end=element.attrib["to"],
        rank=int(element.attrib["priority"]),
        lanes=tuple(_lane(each) for each in lanes),
    )


def _lane(element: Element) -> Lane:
    refused = element.get("disallow", "").split()
    use = _USES.get(element.get("allow", ""), Use.DRIVERS)
    use = Use.NO_USE if "all" in refused else use
    shared = use is Use.DRIVERS and "bicycle" not in refused
    return Lane(
        name=element.attrib["id"],
        use=use,
        cycled=shared or use is Use.CYCLISTS,
        limit_mps=float(element.attrib["speed"]),
        width_m=float(element.attrib["width"]),
        xy_m=_shape(element),
    )


def _shape(element: Element) -> Points:
    points = [point.split(",")[:2] for point in element.attrib["shape"].split()]
    return np.array(points, np.float64)


def _crossing(element: Element) -> Crossing:
    (lane,) = element.iter("lane")
    return Crossing(
        junction=element.attrib["id"][1:].rsplit("_", 1)[0],
        xy_m=_shape(lane),
        width_m=float(lane.attrib["width"]),
        edges=tuple(element.attrib["crossingEdges"].split()),
    )


def _connectors(
    root: Element, edges: dict[str, Edge], inside: dict[str, Element]
) -> tuple[Connector, ...]:
    """Make one connector of each connection, all of its parts put together."""
    names = {lane.name for edge in edges.values() for lane in edge.driven}
    links = [each.attrib for each in root.iter("connection")]
    onward = {f"{each['from']}_{each['fromLane']}": each.get("via") for each in links}
    made = []
    for each in links:
        start = f"{each['from']}_{each['fromLane']}"
        end = f"{each['to']}_{each['toLane']}"
        if not {start, end} <= names or "via" not in each:
            continue
        parts, via = [], each.get("via")
        while via is not None:
            parts.append(_shape(inside[via]))
            via = onward.get(via)
        made.append(
            Connector(
                name=each["via"],
                start=start,
                end=end,
                junction=edges[each["from"]].end,
                xy_m=curves.chain(*parts),
                limit_mps=float(inside[each["via"]].attrib["speed"]),
                turn=each["dir"],
                state=each["state"],
                signal=each.get("tl", ""),
                index=int(each.get("linkIndex", -1)),
            )
        )
    return tuple(made)


def _plan(element: Element) -> SignalPlan:
    phases = list(element.iter("phase"))
    lengths_s = [float(phase.attrib["duration"]) for phase in phases]
    return SignalPlan(
        ends_s=np.cumsum(np.array(lengths_s, np.float64)),
        states=tuple(phase.attrib["state"] for phase in phases),
        offset_s=float(element.get("offset", 0)),
    )
