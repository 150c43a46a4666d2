"""Every way through a town, as one table of points that whole crowds look up at once.

A route is sampled every half metre; positions on it are distances from its start. Sample
``i`` of route ``r`` is row ``first[r] + i`` of the flat arrays.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from infgen.scene import AgentKind
from infgen.sources.towns import curves
from infgen.sources.towns.town import STRIP_SPACING_M, Strip, Town

MAX_STRIPS = 5
"""Nobody's route has more; only walkers could."""
SIDE_ACCEL_MPS2 = {
    AgentKind.VEHICLE: 2.2,
    AgentKind.CYCLIST: 1.8,
    AgentKind.PEDESTRIAN: 9.0,
}
"""Curves are taken no faster than this allows."""
SLOWING_MPS2 = 1.1
"""How hard one slows towards a curve."""
KEEP_RIGHT_M = 0.55
"""Walkers keep so far to the right of the middle of their path."""
ROUNDING_M = 0.8
"""Walkers cut corners within this reach."""


@dataclass(frozen=True, slots=True)
class Routes:
    """All routes of a town.

    Attributes:
        strips: Strips of each route, in order.
        kind: Who uses it.
        turn_rad: How far it turns in all, left or right.
        length_m: Of each route.
        first: Row of its first sample.
        start_m: Where on the route a strip starts; NaN if the route does not use it.
        end_m: Where that strip ends.
        xy_m: Samples.
        strip: Strip of each sample.
        limit_mps: Speed at each sample, curves ahead heeded.
        gate: Next gated strip that starts at or after the sample, or -1.
        gate_m: Where it starts on the route.
    """

    strips: tuple[tuple[int, ...], ...]
    kind: Int64[np.ndarray, " route"]
    turn_rad: Float64[np.ndarray, " route"]
    length_m: Float64[np.ndarray, " route"]
    first: Int64[np.ndarray, " route"]
    start_m: Float64[np.ndarray, "route strip"]
    end_m: Float64[np.ndarray, "route strip"]
    xy_m: Float64[np.ndarray, "sample 2"]
    strip: Int64[np.ndarray, " sample"]
    limit_mps: Float64[np.ndarray, " sample"]
    gate: Int64[np.ndarray, " sample"]
    gate_m: Float64[np.ndarray, " sample"]

    def row(
        self, route: Int64[np.ndarray, "*user"], along_m: Float64[np.ndarray, "*user"]
    ) -> Int64[np.ndarray, "*user"]:
        """Row of the sample at or before a position."""
        last = (self.length_m[route] / STRIP_SPACING_M).astype(np.int64)
        sample = np.clip((along_m / STRIP_SPACING_M).astype(np.int64), 0, last)
        return self.first[route] + sample

    def points(
        self, route: Int64[np.ndarray, "*user"], along_m: Float64[np.ndarray, "*user"]
    ) -> Float64[np.ndarray, "*user 2"]:
        """Points at positions, beyond the ends straight on."""
        last = (self.length_m[route] / STRIP_SPACING_M).astype(np.int64)
        whole = np.clip((along_m / STRIP_SPACING_M).astype(np.int64), 0, last - 1)
        row = self.first[route] + whole
        part = (along_m / STRIP_SPACING_M - whole)[..., None]
        return self.xy_m[row] * (1 - part) + self.xy_m[row + 1] * part

    def starting_with(self, strip: int) -> Int64[np.ndarray, " route"]:
        """Routes whose first strip is this one."""
        return np.array([r for r, s in enumerate(self.strips) if s[0] == strip], np.int64)

    def ending_with(self, strip: int) -> Int64[np.ndarray, " route"]:
        """Routes whose last strip is this one."""
        return np.array([r for r, s in enumerate(self.strips) if s[-1] == strip], np.int64)


def find_routes(town: Town) -> Routes:
    """List every way from a strip that nothing leads to, to one that leads nowhere."""
    ways = [way for source in town.sources for way in _ways(town.strips, (source,))]
    parts = [_Part(town.strips, way) for way in ways]
    counts = np.array([len(part.xy_m) for part in parts])
    start_m = np.full((len(ways), len(town.strips)), np.nan)
    end_m = start_m.copy()
    for row, part in enumerate(parts):
        start_m[row, list(part.way)] = part.ends_m[:-1]
        end_m[row, list(part.way)] = part.ends_m[1:]
    return Routes(
        strips=tuple(ways),
        kind=np.array([int(town.strips[way[0]].kind) for way in ways], np.int64),
        turn_rad=np.array([part.turn_rad for part in parts]),
        length_m=(counts - 1) * STRIP_SPACING_M,
        first=np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64),
        start_m=start_m,
        end_m=end_m,
        xy_m=np.concatenate([part.xy_m for part in parts]),
        strip=np.concatenate([part.strip for part in parts]),
        limit_mps=np.concatenate([part.limit_mps for part in parts]),
        gate=np.concatenate([part.gate for part in parts]),
        gate_m=np.concatenate([part.gate_m for part in parts]),
    )


def _ways(strips: tuple[Strip, ...], way: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    exits = strips[way[-1]].exits
    if not exits and len(way) > 1:
        yield way
    if len(way) < MAX_STRIPS:
        for following in exits:
            if following not in way:
                yield from _ways(strips, (*way, following))


class _Part:
    """One route on its own."""

    def __init__(self, strips: tuple[Strip, ...], way: tuple[int, ...]) -> None:
        self.way = way
        used = [strips[row] for row in way]
        kind = used[0].kind
        whole_m = curves.chain(*(strip.xy_m for strip in used))
        self.ends_m = np.concatenate(
            [[0.0], np.cumsum([curves.length(strip.xy_m) for strip in used])]
        )
        along_m = np.arange(0.0, self.ends_m[-1], STRIP_SPACING_M)
        self.xy_m = curves.points_at(whole_m, along_m)
        if kind == AgentKind.PEDESTRIAN:
            kept_m = curves.smooth(self.xy_m, ROUNDING_M, STRIP_SPACING_M)
            self.xy_m = curves.offset(kept_m, -KEEP_RIGHT_M)
        heading_rad = curves.headings(self.xy_m)
        self.turn_rad = float(heading_rad[-1] - heading_rad[0])
        at = np.searchsorted(self.ends_m, along_m, side="right") - 1
        self.strip = np.array(way, np.int64)[at]
        legal_mps = np.array([strip.limit_mps for strip in used])[at]
        bent = np.maximum(curves.curvatures(self.xy_m, STRIP_SPACING_M), 1e-4)
        self.limit_mps = _heeding_ahead(
            np.minimum(legal_mps, np.sqrt(SIDE_ACCEL_MPS2[kind] / bent))
        )
        self.gate, self.gate_m = self._gates(used, along_m)

    def _gates(
        self, used: list[Strip], along_m: Float64[np.ndarray, " sample"]
    ) -> tuple[Int64[np.ndarray, " sample"], Float64[np.ndarray, " sample"]]:
        gated = [at for at, strip in enumerate(used) if strip.gate is not None]
        starts_m = np.array([*self.ends_m[gated], np.inf])
        following = np.searchsorted(starts_m, along_m, side="left")
        strips = np.array([*(self.way[at] for at in gated), -1], np.int64)
        return strips[following], starts_m[following]


def _heeding_ahead(
    limit_mps: Float64[np.ndarray, " sample"],
) -> Float64[np.ndarray, " sample"]:
    """Lower limits so that a slower stretch ahead can be met by gentle braking."""
    # v^2 falls by 2 a s on the way: a running minimum of v^2 + 2 a s, seen from the end.
    spent = 2 * SLOWING_MPS2 * STRIP_SPACING_M * np.arange(len(limit_mps))
    ahead = np.minimum.accumulate((limit_mps**2 + spent)[::-1])[::-1] - spent
    return np.sqrt(ahead)
