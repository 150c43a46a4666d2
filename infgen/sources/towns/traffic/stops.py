"""Which vehicles park on their way, and which are parked and pull out."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from infgen.sources.towns.road_users import BodyType
from infgen.sources.towns.traffic.demand import FASTEST_MPS, Trip, draw_motorist_of
from infgen.sources.towns.traffic.parking import ParkingSpace, ParkingStop
from infgen.sources.towns.traffic.trips import Ways
from infgen.sources.towns.variety import DriverVariety

SHORT_STAY_S = (8.0, 60.0)
STAY_SHARE = 0.5
"""Of those who park, stay for good."""
_FOR_GOOD_S = 1e5
_COMMON_MPS = 5.0
"""Rough speed of a vehicle on the way to a place."""
_LONGEST_M = 6.0
_WITHIN_STRIP_M = 0.1


def with_stops(
    trips: Sequence[Trip],
    share: float,
    spaces: Sequence[ParkingSpace],
    ways: Ways,
    seconds: float,
    variety: DriverVariety,
    rng: np.random.Generator,
) -> list[Trip]:
    """Let a share of the cars park on their way, and as many pull out.

    Each space is used once.

    Args:
        trips: Everybody's way.
        share: Of the cars.
        spaces: Where one may park.
        ways: Where cars go.
        seconds: How long the town is simulated.
        variety: What drivers there are.
        rng: Of all that is drawn.
    """
    free: dict[str, list[ParkingSpace]] = {}
    for at in rng.permutation(len(spaces)).tolist():
        free.setdefault(spaces[at].edge, []).append(spaces[at])
    found = list(trips)
    cars = [at for at, trip in enumerate(trips) if trip.person.body is BodyType.CAR]
    parking = cars[: round(share * len(cars))]
    if parking:
        parking = rng.permutation(cars)[: len(parking)].tolist()
    for at in parking:
        space = _on_the_way(found[at], free, ways, seconds, rng)
        if space is not None:
            stay_s = (
                _FOR_GOOD_S if rng.random() < STAY_SHARE else rng.uniform(*SHORT_STAY_S)
            )
            stop = ParkingStop(space, None, float(stay_s))
            found[at] = replace(found[at], stops=(stop,))
    for _ in parking:
        edges = [edge for edge, some in free.items() if some and ways.follows[edge][0]]
        if not edges:
            break
        edge = edges[rng.integers(len(edges))]
        until_s = float(rng.uniform(0.0, seconds))
        person = draw_motorist_of(BodyType.CAR, rng, variety)
        space = free[edge].pop()
        if _fits(person.size_lwh_m, space):
            route = ways.walk(edge, FASTEST_MPS * seconds, rng)
            found.append(Trip(person, 0.0, route, False, (ParkingStop(space, until_s),)))
    return sorted(found, key=lambda trip: trip.depart_s)


def _on_the_way(
    trip: Trip,
    free: dict[str, list[ParkingSpace]],
    ways: Ways,
    seconds: float,
    rng: np.random.Generator,
) -> ParkingSpace | None:
    """Take the first free space after some way that has still to be driven."""
    least_m = rng.uniform(0.0, _COMMON_MPS * (seconds - trip.depart_s))
    gone_m, known = 0.0, set(trip.route[:1])
    for edge in trip.route:
        if gone_m >= least_m and edge not in known:
            for space in free.get(edge, ()):
                if _fits(trip.person.size_lwh_m, space):
                    free[edge].remove(space)
                    return space
        known.add(edge)
        gone_m += ways.length_m[edge]
    return None


def _fits(size_lwh_m: tuple[float, float, float], space: ParkingSpace) -> bool:
    length_m, width_m, _ = size_lwh_m
    return length_m <= _LONGEST_M and width_m <= space.wide_m - _WITHIN_STRIP_M
