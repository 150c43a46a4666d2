"""Vehicles that park along the road edge, and that pull out of where they are parked.

SUMO takes a parked vehicle off the lane in one step, and lets it back in when there is a
gap. Here it is led from the lane to its parking space and back over some metres.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from infgen.clock import CLOCK
from infgen.sources.towns.streets import curves
from infgen.sources.towns.streets.network import Edge, Network, Use
from infgen.sources.towns.streets.street_types import Street
from infgen.sources.towns.traffic.simulation import Played

SPACING_M = 26.0
"""From one parking space that is used on the way to the next: none is in another's way."""
FROM_ENDS_M = (26.0, 24.0)
"""Spaces lie at least so far from the start of a street and from its end."""
_STRAIGHT_RAD = 0.05
_LOOK_M = 22.0
"""Streets bend less within so many metres of a space."""
LEAD_M = 12.0
"""Within so many metres a vehicle comes over from its lane, and goes back to it."""
STRAIGHT_M = 5.0
"""It stands straight in its space: it is all over so long before it stops."""
_BEYOND_M = (0.5, 12.0)
"""SUMO puts a parked vehicle so far beyond the middle of the parking strip."""
_NEAR_M = 15.0
_STANDING_MPS = 0.1


@dataclass(frozen=True, slots=True)
class ParkingSpace:
    """A parking space along the road edge.

    Attributes:
        edge: Street it is on.
        lane: Number of the rightmost lane for drivers.
        along_m: Where the front of a vehicle is, from the start of the lane.
        front_m: The same in the town, in the middle of the parking strip.
        heading_rad: Of the lane there.
        wide_m: Width of the strip.
    """

    edge: str
    lane: int
    along_m: float
    front_m: Float64[np.ndarray, "2"]
    heading_rad: float
    wide_m: float


@dataclass(frozen=True, slots=True)
class ParkingStop:
    """A stay in a parking space.

    Attributes:
        space: Where.
        until_s: When it ends, of a vehicle that is there from the beginning; None for one
            that comes.
        duration_s: How long it lasts, of one that comes.
    """

    space: ParkingSpace
    until_s: float | None
    duration_s: float = 0.0


def find_spaces(network: Network, streets: Mapping[str, Street]) -> list[ParkingSpace]:
    """Find spaces along straight parts of streets with parked cars and no bicycle lane."""
    return [
        space
        for name, street in streets.items()
        if street.parking_m and not street.bike_m
        for space in _spaces_of(network.edges[name], street)
    ]


def _spaces_of(edge: Edge, street: Street) -> list[ParkingSpace]:
    at = next(at for at, lane in enumerate(edge.lanes) if lane.use is Use.DRIVERS)
    lane, strip = edge.lanes[at], edge.outer
    if strip.use is not Use.NO_USE:
        return []
    xy_m = curves.resample(lane.xy_m, 1.0)
    known_m, heading_rad = curves.arc_lengths(xy_m), curves.headings(xy_m)
    first_m, last_m = FROM_ENDS_M[0], known_m[-1] - FROM_ENDS_M[1]
    found = []
    for along_m in np.arange(first_m, last_m, SPACING_M).tolist():
        near = np.abs(known_m - along_m) < _LOOK_M
        if np.ptp(heading_rad[near]) > _STRAIGHT_RAD:
            continue
        along_rad = float(np.interp(along_m, known_m, heading_rad))
        right = np.array([np.sin(along_rad), -np.cos(along_rad)])
        aside_m = (lane.width_m + strip.width_m) / 2
        front_m = curves.points_at(xy_m, np.array([along_m]))[0] + aside_m * right
        found.append(
            ParkingSpace(edge.name, at, along_m, front_m, along_rad, street.parking_m)
        )
    return found


def with_parking(played: Played, stops: Sequence[tuple[ParkingStop, ...]]) -> Played:
    """Lead vehicles into and out of their parking spaces.

    Args:
        played: What SUMO gave: vehicles that are parked stand beyond the parking strip.
        stops: Of each trip.
    """
    front_m, speed_mps = played.front_m.copy(), played.speed_mps.copy()
    for row, some in enumerate(stops):
        for stop in some:
            space = stop.space
            right = np.array([np.sin(space.heading_rad), -np.cos(space.heading_rad)])
            from_m = played.front_m[row] - space.front_m
            off_m = from_m @ right
            parked = (off_m > _BEYOND_M[0]) & (off_m < _BEYOND_M[1])
            parked &= np.linalg.norm(from_m - off_m[:, None] * right, axis=1) < _NEAR_M
            parked &= played.present[row] & (played.speed_mps[row] < _STANDING_MPS)
            if parked.any():
                share = _share_aside(parked, played.speed_mps[row])
                front_m[row] -= (share * off_m)[:, None] * right
                speed_mps[row, parked] = 0.0
    return replace(played, front_m=front_m, speed_mps=speed_mps)


def _share_aside(
    parked: Bool[np.ndarray, " step"], speed_mps: Float64[np.ndarray, " step"]
) -> Float64[np.ndarray, " step"]:
    """How far a vehicle is over, from its lane at 0 to its parking space at 1."""
    steps = np.flatnonzero(parked)
    first, last = steps[0], steps[-1]
    gone_m = np.cumsum(speed_mps) * CLOCK.step_s
    to_go_m = np.maximum(gone_m[first] - gone_m, 0.0)
    since_m = np.maximum(gone_m - gone_m[last], 0.0)
    before = _smooth(1.0 - (to_go_m - STRAIGHT_M) / LEAD_M)
    after = _smooth(1.0 - since_m / LEAD_M)
    at = np.arange(len(parked))
    return np.where(at < first, before, np.where(at > last, after, 1.0))


def _smooth(share: Float64[np.ndarray, " step"]) -> Float64[np.ndarray, " step"]:
    """Go from 0 to 1 without corners."""
    share = share.clip(0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)
