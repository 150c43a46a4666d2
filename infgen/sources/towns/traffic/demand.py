"""Who is under way in a town and when, as SUMO's route file."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from infgen.sources.towns.road_users import (
    BodyType,
    RoadUser,
    draw_cyclist,
    draw_motorist,
    draw_walker,
)
from infgen.sources.towns.streets.network import Network
from infgen.sources.towns.traffic.parking import ParkingStop
from infgen.sources.towns.traffic.trips import Ways, find_walks, find_ways
from infgen.sources.towns.variety import BASIC, CarFollowing, DemandVariety, DriverVariety

FASTEST_MPS = 14.0
"""Routes are long enough to be under way all the time at this speed."""
NUM_WANDERERS = 14
"""Cars that never leave town: they make the trips."""
LONGEST_WALK_M = 700.0
_STOP_WITHIN_M = 4.0
"""Who parks stops within the last metres before a place."""
REACTION_S = 0.4
"""Drivers make up their minds so often: as people do, and at half the cost."""


@dataclass(frozen=True, slots=True)
class Level:
    """How much is going on in a town.

    Attributes:
        cars_per_km: On every kilometre of a collector's lane at the beginning.
        cars_per_hour: That come from out of town on a collector's lane.
        cyclists: How many for every hundred cars.
        walkers_per_km: On every kilometre of pavement.
        parking: Share of the cars that park on their way; as many pull out.
    """

    cars_per_km: float
    cars_per_hour: float
    cyclists: float
    walkers_per_km: float
    parking: float = 0.0


@dataclass(frozen=True, slots=True)
class Trip:
    """Somebody's way.

    Attributes:
        person: Who.
        depart_s: When they set out.
        route: Edges in a row.
        anywhere: Whether they begin anywhere on the first edge, not at its start.
        stops: Where they park; one that is parked at the beginning pulls out of the first.
    """

    person: RoadUser
    depart_s: float
    route: list[str]
    anywhere: bool
    stops: tuple[ParkingStop, ...] = ()

    @property
    def drives(self) -> bool:
        """Whether they go by vehicle or bicycle."""
        return self.person.body is not BodyType.WALKER

    @property
    def pulls_out(self) -> bool:
        """Whether they are parked at the beginning."""
        return bool(self.stops) and self.stops[0].until_s is not None


def draw_level(rng: np.random.Generator, variety: DemandVariety = BASIC.demand) -> Level:
    """Draw how much is going on, from next to nothing to dense."""
    cars = float(np.exp(rng.uniform(*np.log(variety.cars_per_km))))
    return Level(
        cars_per_km=cars,
        cars_per_hour=cars * float(rng.uniform(14.0, 28.0)),
        cyclists=float(rng.choice([1.0, 4.0, 10.0], p=[0.5, 0.35, 0.15])),
        walkers_per_km=float(np.exp(rng.uniform(*np.log(variety.walkers_per_km)))),
        parking=float(rng.uniform(0.0, variety.parking)) if variety.parking else 0.0,
    )


def draw_trips(
    network: Network,
    level: Level,
    seconds: float,
    rng: np.random.Generator,
    variety: DriverVariety = BASIC.drivers,
) -> list[Trip]:
    """Draw everybody's way, by the time they set out.

    Args:
        network: The town.
        level: How much is going on.
        seconds: How long it is simulated.
        rng: Of all that is drawn.
        variety: What drivers there are.
    """
    draw_driver = partial(draw_motorist, variety=variety)
    reach_m = FASTEST_MPS * seconds
    driving, cycling = (find_ways(network, cycling=each) for each in (False, True))
    trips = [
        Trip(draw_motorist_of(BodyType.CAR, rng, variety), 0.0, route, anywhere=True)
        for route in _wanderings(driving, reach_m, rng)
    ]
    share = level.cyclists / 100.0
    for ways, draw, part in (
        (driving, draw_driver, 1.0),
        (cycling, draw_cyclist, share),
    ):
        starts = _starts(ways, level, part, seconds, rng)
        trips += [
            Trip(draw(rng), depart_s, ways.walk(edge, reach_m, rng), anywhere=anywhere)
            for edge, depart_s, anywhere in starts
        ]
    total_m = sum(driving.length_m.values())
    count = rng.poisson(level.walkers_per_km * total_m / 1000.0)
    walks = find_walks(network, int(count), LONGEST_WALK_M, rng)
    late = rng.random(len(walks)) < 0.4
    depart_s = np.where(late, rng.uniform(0.0, seconds, len(walks)), 0.0)
    trips += [
        Trip(draw_walker(rng), float(time_s), list(walk), anywhere=True)
        for time_s, walk in zip(depart_s, walks, strict=True)
    ]
    return sorted(trips, key=lambda trip: trip.depart_s)


def draw_motorist_of(
    body: BodyType, rng: np.random.Generator, variety: DriverVariety = BASIC.drivers
) -> RoadUser:
    """Draw a driver of a kind of vehicle."""
    while True:
        person = draw_motorist(rng, variety)
        if person.body is body:
            return person


def _wanderings(ways: Ways, reach_m: float, rng: np.random.Generator) -> list[list[str]]:
    starts = rng.choice(ways.inner, NUM_WANDERERS)
    return [ways.walk(str(edge), reach_m, rng, leave=False) for edge in starts]


def _starts(
    ways: Ways, level: Level, part: float, seconds: float, rng: np.random.Generator
) -> list[tuple[str, float, bool]]:
    """Draw where and when people set out: on their way at time 0, or from out of town."""
    found = []
    for edge, length_m in ways.length_m.items():
        if not ways.follows[edge][0]:
            continue
        cars = part * level.cars_per_km * ways.busy[edge]
        there = rng.poisson(cars * length_m / 1000.0)
        found += [(edge, 0.0, True)] * int(there)
    for edge in ways.sources:
        per_hour = part * level.cars_per_hour * ways.busy[edge]
        count = rng.poisson(per_hour * seconds / 3600.0)
        times_s = np.sort(rng.uniform(0.1, seconds, count))
        found += [(edge, float(time_s), False) for time_s in times_s]
    return found


def write_routes(trips: list[Trip], path: Path) -> None:
    """Write a route file. The position of a trip in the list is the name of its person."""
    root = Element("routes")
    for at, trip in enumerate(trips):
        _write_type(root, f"t{at}", trip.person)
        about = {"id": str(at), "type": f"t{at}", "depart": f"{trip.depart_s:.1f}"}
        if not trip.drives:
            person = SubElement(root, "person", about | {"departPos": "random"})
            SubElement(person, "walk", {"edges": " ".join(trip.route)})
            continue
        start = {"departPos": "base", "departSpeed": "max", "departLane": "best"}
        if trip.anywhere:
            start = {"departPos": "random_free", "departSpeed": "max"}
            start["departLane"] = "best"
        if trip.pulls_out:
            lane = str(trip.stops[0].space.lane)
            start = {"departPos": "stop", "departSpeed": "0", "departLane": lane}
        vehicle = SubElement(root, "vehicle", about | start)
        SubElement(vehicle, "route", {"edges": " ".join(trip.route)})
        for stop in trip.stops:
            _write_stop(vehicle, stop)
    ElementTree.ElementTree(root).write(path)


def _write_stop(vehicle: Element, stop: ParkingStop) -> None:
    space = stop.space
    about = {
        "lane": f"{space.edge}_{space.lane}",
        "startPos": f"{space.along_m - _STOP_WITHIN_M:.1f}",
        "endPos": f"{space.along_m:.1f}",
        "parking": "true",
    }
    if stop.until_s is not None:
        about["until"] = f"{stop.until_s:.1f}"
    else:
        about["duration"] = f"{stop.duration_s:.1f}"
    SubElement(vehicle, "stop", about)


def _write_type(root: Element, name: str, person: RoadUser) -> None:
    length_m, width_m, height_m = person.size_lwh_m
    about = {
        "id": name,
        "vClass": person.body.value,
        "length": f"{length_m:.3f}",
        "width": f"{width_m:.3f}",
        "height": f"{height_m:.3f}",
    }
    if person.body is BodyType.WALKER:
        about |= {"maxSpeed": f"{person.haste:.3f}", "speedDev": "0"}
    else:
        about |= _driving(person)
    SubElement(root, "vType", about)


def _driving(person: RoadUser) -> dict[str, str]:
    cycling = person.body is BodyType.BICYCLE
    limits = (
        {"maxSpeed": f"{person.haste:.3f}", "speedDev": "0"}
        if cycling
        else {"speedFactor": f"{person.haste:.3f}", "speedDev": "0"}
    )
    manner = person.lane_changing
    if person.car_following is CarFollowing.KRAUSS:
        limits["sigma"] = f"{person.imperfection:.3f}"
    return limits | {
        "carFollowModel": person.car_following.value,
        "actionStepLength": f"{REACTION_S:g}",
        "tau": f"{person.headway_s:.3f}",
        "accel": f"{person.accel_mps2:.3f}",
        "decel": f"{person.brake_mps2:.3f}",
        "impatience": "0.5",
        "minGap": f"{person.gap_m:.2f}",
        "latAlignment": "right" if cycling else f"{person.aside_m:.3f}",
        "maxSpeedLat": f"{manner.lateral_mps:.2f}",
        "lcSpeedGain": f"{manner.speed_gain:.2f}",
        "lcCooperative": f"{manner.cooperation:.2f}",
        "lcAssertive": f"{manner.assertiveness:.2f}",
        "lcKeepRight": f"{manner.keep_right:.2f}",
        "minGapLat": "0.5",
        "startupDelay": f"{person.hesitation_s:.2f}",
    }
