"""Lanes, painted lines and kerbs of a junction, from its arms.

Arms are in counter-clockwise order. Corner ``c`` lies between arm ``c`` and the next: its
kerb comes in along the left of the one and goes out along the right of the other, with the
road on its left all the way.
"""

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from infgen.scene import AgentKind, LaneType, RoadLineType
from infgen.sources.towns import curves
from infgen.sources.towns.arms import LANE_WIDTH_M, STOP_LINE_M, Arm, Verge, turned_back
from infgen.sources.towns.curves import Points
from infgen.sources.towns.town import STRIP_SPACING_M, Gate, Line, Sign, Strip

MPS_PER_MPH = 0.44704
VEHICLE_WIDTH_M = 2.6
CYCLIST_WIDTH_M = 1.2
STRAIGHT_RAD = 0.6
"""A path through the junction that turns less goes straight on."""

Key = tuple[Any, ...]


class Control(Enum):
    """Who says who goes first."""

    NONE = "none"
    SIGNALS = "signals"
    MINOR_STOPS = "minor stops"
    ALL_STOP = "all stop"


class Turn(Enum):
    """Where a path through the junction leads; its rank among those that need not stop."""

    STRAIGHT = 1
    RIGHT = 2
    LEFT = 3


@dataclass(frozen=True, slots=True)
class Draft:
    """A town under construction: strips and lines by name, exits and neighbours as names.

    Attributes:
        arms: Of the junction.
        control: Of the junction.
        paths: Fields of each strip but those below.
        exits: Names of the strips that follow.
        beside: Names of the strips to the left and to the right.
        bounds: Names of the lines to the left and to the right.
        lines: Painted lines.
    """

    arms: tuple[Arm, ...]
    control: Control
    paths: dict[Key, dict[str, Any]] = field(default_factory=dict)
    exits: dict[Key, list[Key]] = field(default_factory=dict)
    beside: dict[Key, tuple[Key, Key]] = field(default_factory=dict)
    bounds: dict[Key, tuple[Key, Key]] = field(default_factory=dict)
    lines: dict[Key, Line] = field(default_factory=dict)

    def add(self, key: Key, xy_m: Points, **fields: Any) -> None:
        """Add a strip, its points evenly spaced."""
        even_m = curves.resample(xy_m, STRIP_SPACING_M)
        self.paths[key] = {"xy_m": even_m, **fields}

    def lead(self, key: Key, following: Key) -> None:
        """Let one strip lead to another."""
        self.exits.setdefault(key, []).append(following)

    def strips(self) -> tuple[Strip, ...]:
        """Number everything and make the strips."""
        rows = {key: row for row, key in enumerate(self.paths)}
        lines = {key: row for row, key in enumerate(self.lines)}
        nothing: tuple[Key, Key] = ((), ())
        made = []
        for key, fields in self.paths.items():
            left, right = (rows.get(name, -1) for name in self.beside.get(key, nothing))
            bounds = (lines.get(name, -1) for name in self.bounds.get(key, nothing))
            left_line, right_line = bounds
            exits = tuple(rows[name] for name in self.exits.get(key, []))
            made.append(
                Strip(
                    **fields,
                    exits=exits,
                    left=left,
                    right=right,
                    left_line=left_line,
                    right_line=right_line,
                )
            )
        return tuple(made)

    def signs(self) -> tuple[Sign, ...]:
        """Put a stop sign beside every stop line whose traffic must stop."""
        made = []
        for at, arm in enumerate(self.arms):
            gates = [(key, fields.get("gate")) for key, fields in self.paths.items()]
            rows = [
                row
                for row, (key, gate) in enumerate(gates)
                if gate is not None and gate.stop and key[1] == at
            ]
            if rows:
                place = arm.outward(arm.half_m + 0.6, STOP_LINE_M, STOP_LINE_M + 1.0)[0]
                made.append(Sign(place, tuple(rows)))
        return tuple(made)


def draw_streets(draft: Draft) -> None:
    """Add lanes, bicycle lanes, the ways through the junction, and painted lines."""
    for at, arm in enumerate(draft.arms):
        _arm_lines(draft, at, arm)
        _arm_lanes(draft, at, arm)
    if len(draft.arms) == 2:
        _through_lines(draft)
    for start in range(len(draft.arms)):
        for end in range(len(draft.arms)):
            if start != end:
                _turns(draft, start, end)
                _bike_turn(draft, start, end)


def draw_kerbs(arms: tuple[Arm, ...]) -> tuple[Points, ...]:
    """Draw the road edges, one per corner, the road on their left."""
    return tuple(
        around_corner(arm, arms[(at + 1) % len(arms)], arm.half_m, None)
        for at, arm in enumerate(arms)
    )


def around_corner(arm: Arm, following: Arm, left_m: float, reach_m: float | None) -> Points:
    """Draw a line in along one arm's left and out along the right of the next.

    Args:
        arm: Where it comes in.
        following: The next arm counter-clockwise, where it goes out.
        left_m: Distance of the line from the first arm's middle.
        reach_m: How far out along the arms it begins and ends; None for their whole length.
    """
    right_m = left_m - arm.half_m + following.half_m
    corner = curves.join(
        turned_back(arm.mouth(left_m)), following.mouth(-right_m), STRIP_SPACING_M
    )
    coming = arm.outward(left_m, 0.0, reach_m)[::-1]
    going = following.outward(-right_m, 0.0, reach_m)
    return curves.chain(coming, corner, going)


def _arm_lines(draft: Draft, at: int, arm: Arm) -> None:
    if arm.lined:
        double = RoadLineType.SOLID_DOUBLE_YELLOW
        single = RoadLineType.BROKEN_SINGLE_YELLOW
        kind = double if arm.num_lanes > 1 or len(draft.arms) > 2 else single
        draft.lines["middle", at] = Line(kind, arm.outward(0.0, STOP_LINE_M))
    for side in (-1, 1):
        for lane in range(1, arm.num_lanes):
            xy_m = arm.outward(side * lane * LANE_WIDTH_M, STOP_LINE_M)
            kind = RoadLineType.BROKEN_SINGLE_WHITE
            draft.lines["divider", at, side, lane] = Line(kind, xy_m)
        if arm.verge is not Verge.GUTTER:
            xy_m = arm.outward(side * arm.lanes_m, STOP_LINE_M)
            draft.lines["side", at, side] = Line(RoadLineType.SOLID_SINGLE_WHITE, xy_m)


def _through_lines(draft: Draft) -> None:
    """Carry the lines of one arm on to the other, where there is no junction."""
    arm, other = draft.arms
    for key in [key for key in draft.lines if key[1] == 0]:
        left_m = _left_of(arm, key)
        xy_m = _through(arm, other, left_m, -left_m)
        draft.lines["through", *key] = Line(draft.lines[key].kind, xy_m)


def _left_of(arm: Arm, key: Key) -> float:
    if key[0] == "middle":
        return 0.0
    return key[2] * (arm.lanes_m if key[0] == "side" else key[3] * LANE_WIDTH_M)


def _through(arm: Arm, other: Arm, left_m: float, other_left_m: float) -> Points:
    """Draw a line from one arm's stop line through the junction to another's."""
    middle = curves.join(
        turned_back(arm.mouth(left_m)), other.mouth(other_left_m), STRIP_SPACING_M
    )
    coming = arm.outward(left_m, 0.0, STOP_LINE_M)[::-1]
    return curves.chain(coming, middle, other.outward(other_left_m, 0.0, STOP_LINE_M))


def _arm_lanes(draft: Draft, at: int, arm: Arm) -> None:
    fields = {"kind": AgentKind.VEHICLE, "width_m": VEHICLE_WIDTH_M}
    fields |= {
        "limit_mps": arm.limit_mph * MPS_PER_MPH,
        "lane_type": LaneType.SURFACE_STREET,
    }
    for lane in range(arm.num_lanes):
        left_m = arm.lane_left_m(lane)
        draft.add(("in", at, lane), arm.inward(left_m, STOP_LINE_M), **fields)
        draft.add(("out", at, lane), arm.outward(-left_m, STOP_LINE_M), **fields)
        for way, side in (("in", 1), ("out", -1)):
            draft.beside[way, at, lane] = ((way, at, lane - 1), (way, at, lane + 1))
            draft.bounds[way, at, lane] = _lane_bounds(arm, at, side, lane)
    if arm.verge is Verge.BIKE_LANE:
        left_m = arm.lanes_m + Verge.BIKE_LANE.value / 2
        fields |= {"kind": AgentKind.CYCLIST, "width_m": CYCLIST_WIDTH_M}
        fields |= {"lane_type": LaneType.BIKE_LANE}
        draft.add(("bike in", at), arm.inward(left_m, STOP_LINE_M), **fields)
        draft.add(("bike out", at), arm.outward(-left_m, STOP_LINE_M), **fields)
        for way, side in (("bike in", 1), ("bike out", -1)):
            draft.bounds[way, at] = (("side", at, side), ())


def _lane_bounds(arm: Arm, at: int, side: int, lane: int) -> tuple[Key, Key]:
    last = lane + 1 == arm.num_lanes
    left = ("divider", at, side, lane) if lane else ("middle", at)
    right = ("side", at, side) if last else ("divider", at, side, lane + 1)
    return left, right


def turn_between(draft: Draft, start: int, end: int) -> Turn:
    """Say where a path from one arm to another leads."""
    inward_rad = turned_back(draft.arms[start].mouth(0.0))[2]
    turn_rad = draft.arms[end].mouth(0.0)[2] - inward_rad
    turn_rad = (turn_rad + np.pi) % (2 * np.pi) - np.pi
    if len(draft.arms) == 2 or abs(turn_rad) < STRAIGHT_RAD:
        return Turn.STRAIGHT
    return Turn.LEFT if turn_rad > 0 else Turn.RIGHT


def _turns(draft: Draft, start: int, end: int) -> None:
    """Add the ways from the lanes of one arm to those of another."""
    turn = turn_between(draft, start, end)
    arm, other = draft.arms[start], draft.arms[end]
    straight = [(lane, lane) for lane in range(min(arm.num_lanes, other.num_lanes))]
    pairs = {
        Turn.STRAIGHT: straight,
        Turn.RIGHT: [(arm.num_lanes - 1, other.num_lanes - 1)],
        Turn.LEFT: [(0, 0)],
    }[turn]
    for lane, into in pairs:
        key = ("turn", start, lane, end, into)
        xy_m = _through(arm, other, arm.lane_left_m(lane), -other.lane_left_m(into))
        draft.add(
            key,
            xy_m,
            kind=AgentKind.VEHICLE,
            width_m=VEHICLE_WIDTH_M,
            limit_mps=min(arm.limit_mph, other.limit_mph) * MPS_PER_MPH,
            lane_type=LaneType.SURFACE_STREET,
            gate=_gate(draft, start, turn),
        )
        draft.lead(("in", start, lane), key)
        draft.lead(key, ("out", end, into))
        if turn is Turn.STRAIGHT:
            keys = [("turn", start, lane + by, end, into + by) for by in (-1, 1)]
            draft.beside[key] = (keys[0], keys[1])
        if len(draft.arms) == 2:
            side = 1 if start == 0 else -1
            left, right = _lane_bounds(arm, 0, side, lane)
            draft.bounds[key] = (("through", *left), ("through", *right))


def _bike_turn(draft: Draft, start: int, end: int) -> None:
    turn = turn_between(draft, start, end)
    arm, other = draft.arms[start], draft.arms[end]
    if turn is Turn.LEFT or {arm.verge, other.verge} != {Verge.BIKE_LANE}:
        return
    key = ("bike turn", start, end)
    xy_m = _through(
        arm,
        other,
        arm.lanes_m + Verge.BIKE_LANE.value / 2,
        -other.lanes_m - Verge.BIKE_LANE.value / 2,
    )
    draft.add(
        key,
        xy_m,
        kind=AgentKind.CYCLIST,
        width_m=CYCLIST_WIDTH_M,
        limit_mps=min(arm.limit_mph, other.limit_mph) * MPS_PER_MPH,
        lane_type=LaneType.BIKE_LANE,
        gate=_gate(draft, start, turn),
    )
    draft.lead(("bike in", start), key)
    draft.lead(key, ("bike out", end))


def _gate(draft: Draft, start: int, turn: Turn) -> Gate | None:
    """Decide what must hold before traffic of an arm may go."""
    match draft.control:
        case Control.SIGNALS:
            return Gate(turn.value, group=start % 2)
        case Control.MINOR_STOPS if start % 2:
            return Gate(turn.value + len(Turn), stop=True)
        case Control.ALL_STOP:
            return Gate(Turn.STRAIGHT.value, stop=True)
        case Control.NONE if not any(arm.crosswalk for arm in draft.arms):
            return None
        case _:
            return Gate(turn.value)
