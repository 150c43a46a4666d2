"""A synthetic place: where road users go, what is painted, who must wait for whom.

Town frame: metres, the junction at the origin, headings counter-clockwise from +x, traffic
on the right. A simulator needs only the strips; the map needs all of it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64

from infgen.scene import AgentKind, LaneType, RoadLineType, SignalState
from infgen.sources.towns.curves import Points, resample

NO_GROUP = -1
"""Signal group of a gate without a signal."""

STRIP_SPACING_M = 0.5


@dataclass(frozen=True, slots=True)
class Gate:
    """The right to go onto a strip that others cross.

    Attributes:
        rank: Who goes first: a lower rank is never made to wait by a higher one.
        group: Signal group that opens the gate, or ``NO_GROUP``.
        stop: Whether one must stand still first.
    """

    rank: int
    group: int = NO_GROUP
    stop: bool = False


@dataclass(frozen=True, slots=True)
class Strip:
    """A path along which road users of one kind follow each other.

    Attributes:
        kind: Who uses it.
        xy_m: Its middle, in the direction of travel.
        width_m: What its users may take up.
        limit_mps: Speed limit.
        exits: Strips that follow.
        lane_type: As a lane of the map; None for what maps do not show.
        left: Strip beside it in the same direction, or -1; ``right`` likewise.
        left_line: Painted line along its left, or -1; ``right_line`` likewise.
        gate: What opens it; None if nobody crosses it.
    """

    kind: AgentKind
    xy_m: Points
    width_m: float
    limit_mps: float
    exits: tuple[int, ...] = ()
    lane_type: LaneType | None = None
    left: int = -1
    right: int = -1
    left_line: int = -1
    right_line: int = -1
    gate: Gate | None = None


@dataclass(frozen=True, slots=True)
class Line:
    """A painted line."""

    kind: RoadLineType
    xy_m: Points


@dataclass(frozen=True, slots=True)
class Sign:
    """A stop sign, and the strips that it speaks to."""

    xy_m: Float64[np.ndarray, "2"]
    strips: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """Two groups of signals that take turns.

    Attributes:
        green_s: How long each group goes.
        caution_s: How long a light then warns.
        clear_s: How long all wait before the other group goes.
        walk_s: How long after the start of a green walkers may set out beside it.
        start_s: Where in the cycle time 0 stands.
    """

    green_s: tuple[float, float]
    caution_s: float
    clear_s: float
    walk_s: float
    start_s: float

    def state(self, group: int, time_s: float) -> SignalState:
        """Return what a group shows at a time."""
        since_s = self._since_green(group, time_s)
        if since_s < self.green_s[group]:
            return SignalState.GO
        if since_s < self.green_s[group] + self.caution_s:
            return SignalState.CAUTION
        return SignalState.STOP

    def walk(self, group: int, time_s: float) -> bool:
        """Say whether walkers along the traffic of a group may set out."""
        return bool(self._since_green(group, time_s) < self.walk_s)

    def _since_green(self, group: int, time_s: float) -> float:
        turn_s = [green_s + self.caution_s + self.clear_s for green_s in self.green_s]
        return (time_s + self.start_s - group * turn_s[0]) % sum(turn_s)


@dataclass(frozen=True)
class Town:
    """All there is before anyone moves.

    Attributes:
        strips: Where road users go; exits and neighbours are positions in this list.
        lines: Painted lines.
        edges: Kerbs, the road on their left.
        crosswalks: Outlines.
        bumps: Outlines of speed bumps.
        driveways: Outlines.
        signs: Stop signs.
        buildings: Blocks that hide what is behind: [x, y, heading, length, width].
        parked: Poses and sizes of parked cars: [x, y, heading, length, width, height].
        plan: Of the signals; None without them.
    """

    strips: tuple[Strip, ...]
    lines: tuple[Line, ...]
    edges: tuple[Points, ...]
    crosswalks: tuple[Points, ...]
    bumps: tuple[Points, ...]
    driveways: tuple[Points, ...]
    signs: tuple[Sign, ...]
    buildings: Float64[np.ndarray, "building 5"]
    parked: Float64[np.ndarray, "parked 6"]
    plan: SignalPlan | None

    @cached_property
    def sources(self) -> tuple[int, ...]:
        """Strips that no other leads to."""
        led_to = {following for strip in self.strips for following in strip.exits}
        return tuple(row for row in range(len(self.strips)) if row not in led_to)

    @cached_property
    def conflicts(self) -> Bool[np.ndarray, "strip strip"]:
        """Which gated strips must not be used at once.

        Strips that leave the same one do not conflict: there people queue.
        """
        gated = [row for row, strip in enumerate(self.strips) if strip.gate is not None]
        sparse = {row: resample(self.strips[row].xy_m, 1.0) for row in gated}
        entries = {
            row: {i for i, s in enumerate(self.strips) if row in s.exits} for row in gated
        }
        found = np.zeros((len(self.strips), len(self.strips)), dtype=bool)
        for one in gated:
            for other in gated:
                apart = np.linalg.norm(
                    sparse[one][:, None] - sparse[other][None], axis=-1
                ).min()
                reach_m = (self.strips[one].width_m + self.strips[other].width_m) / 2
                found[one, other] = apart < reach_m and not entries[one] & entries[other]
        walkers = np.array([strip.kind == AgentKind.PEDESTRIAN for strip in self.strips])
        return found & ~(walkers[:, None] & walkers[None])
