"""A town: streets, surroundings, and a stretch of its traffic as bodies."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Bool, Float64, Int64

from infgen.clock import CLOCK
from infgen.scene import RoadMap
from infgen.sources.towns.road_users import BodyType
from infgen.sources.towns.streets.boxes import clear_way
from infgen.sources.towns.streets.layouts import draw_layout
from infgen.sources.towns.streets.markings import (
    draw_bumps,
    draw_crosswalks,
    draw_lines,
    draw_signs,
)
from infgen.sources.towns.streets.network import Network, read_network
from infgen.sources.towns.streets.plain_xml import build_net
from infgen.sources.towns.streets.plots import draw_plenty
from infgen.sources.towns.streets.road_edges import draw_road_edges
from infgen.sources.towns.streets.road_map import Furniture, draw_map
from infgen.sources.towns.streets.street_types import Street
from infgen.sources.towns.streets.surroundings import Surroundings, surround
from infgen.sources.towns.streets.topology import draw_skeleton
from infgen.sources.towns.traffic.demand import Trip, draw_level, draw_trips, write_routes
from infgen.sources.towns.traffic.motion import Bodies, follow
from infgen.sources.towns.traffic.parking import find_spaces, with_parking
from infgen.sources.towns.traffic.simulation import play
from infgen.sources.towns.traffic.stops import with_stops
from infgen.sources.towns.traffic.trips import find_ways
from infgen.sources.towns.variety import BASIC, Variety

WARM_UP_S = 35.0
"""Traffic runs so long before anyone records it; in wide towns as many times longer as they
are wide."""
_MOST_SEED = 1 << 31


@dataclass(frozen=True, slots=True)
class Town:
    """All there is to record. Town frame: metres, the middle of the town at the origin.

    Attributes:
        network: Streets.
        road_map: The map.
        lane_ids: Feature ids of lanes and of ways across junctions, by name.
        surroundings: What stands beside the road.
        kind: ``AgentType`` of everyone under way.
        size_lwh_m: Their boxes.
        car: Who drives a car.
        bodies: Where they are at each recorded step.
        begins_s: Time of the first recorded step, as the plans of the lights count it.
    """

    network: Network
    road_map: RoadMap
    lane_ids: dict[str, int]
    surroundings: Surroundings
    kind: Int64[np.ndarray, " trip"]
    size_lwh_m: Float64[np.ndarray, "trip 3"]
    car: Bool[np.ndarray, " trip"]
    bodies: Bodies
    begins_s: float

    @property
    def num_steps(self) -> int:
        """Number of recorded steps."""
        return int(self.bodies.present.shape[1])


def stream(*words: object) -> np.random.Generator:
    """Return random numbers that depend on some words alone."""
    digest = hashlib.sha256("/".join(map(str, words)).encode()).digest()
    return np.random.default_rng(np.frombuffer(digest, np.uint32).tolist())


def make_town(
    rng: np.random.Generator,
    num_steps: int,
    spread: float = 1.0,
    variety: Variety = BASIC,
) -> Town:
    """Draw a town and record its traffic for so many steps.

    Args:
        rng: Of all that is drawn.
        num_steps: How long its traffic is recorded.
        spread: How many times as wide as most it is. No street leads out of a wide one.
        variety: Ranges that all is drawn from.

    Raises:
        SumoError: if SUMO is missing or fails.
    """
    with TemporaryDirectory(prefix="infgen-town-") as name:
        folder = Path(name)
        skeleton = draw_skeleton(folder, rng, spread, variety.streets)
        layout = draw_layout(skeleton, rng, variety.streets)
        net = build_net(layout, folder, rng, variety.streets)
        network = read_network(net)
        streets = {
            f"e{link}{way}": street
            for link, street in enumerate(layout.street)
            for way in "fb"
            if f"e{link}{way}" in network.edges
        }
        warm_up_s = WARM_UP_S * spread
        seconds = warm_up_s + num_steps * CLOCK.step_s
        trips = _draw_trips(network, streets, seconds, variety, rng)
        write_routes(trips, folder / "town.rou.xml")
        seed = int(rng.integers(_MOST_SEED))
        first = sum(trip.drives and trip.depart_s == 0 for trip in trips)
        played = play(
            net,
            folder / "town.rou.xml",
            len(trips),
            first,
            warm_up_s,
            num_steps,
            seed,
            variety.drivers.inattention,
        )
    if any(trip.stops for trip in trips):
        played = with_parking(played, [trip.stops for trip in trips])
    bodies = follow(played, *_bodies(trips))
    return _with_traffic(network, streets, trips, bodies, warm_up_s, rng)


def _draw_trips(
    network: Network,
    streets: dict[str, Street],
    seconds: float,
    variety: Variety,
    rng: np.random.Generator,
) -> list[Trip]:
    level = draw_level(rng, variety.demand)
    trips = draw_trips(network, level, seconds, rng, variety.drivers)
    if not level.parking:
        return trips
    spaces, ways = find_spaces(network, streets), find_ways(network, cycling=False)
    return with_stops(trips, level.parking, spaces, ways, seconds, variety.drivers, rng)


def _bodies(trips: list[Trip]) -> tuple[np.ndarray, np.ndarray]:
    """Length of everyone, and who walks."""
    length_m = np.array([trip.person.size_lwh_m[0] for trip in trips])
    return length_m, np.array([not trip.drives for trip in trips])


def _with_traffic(
    network: Network,
    streets: dict[str, Street],
    trips: list[Trip],
    bodies: Bodies,
    begins_s: float,
    rng: np.random.Generator,
) -> Town:
    size_lwh_m = np.array([trip.person.size_lwh_m for trip in trips])
    surroundings = surround(network, streets, draw_plenty(rng), rng)
    trip, step = np.nonzero(bodies.present)
    parked = clear_way(surroundings.parked, bodies.pose[trip, step], size_lwh_m[trip, :2])
    surroundings = replace(surroundings, parked=parked)
    furniture = Furniture(
        lines=list(draw_lines(network, streets)),
        road_edges=list(draw_road_edges(network)),
        crosswalks=draw_crosswalks(network, rng),
        driveways=surroundings.driveways,
        bumps=draw_bumps(network, streets, rng),
        signs=list(draw_signs(network)),
    )
    road_map, lane_ids = draw_map(network, furniture)
    return Town(
        network=network,
        road_map=road_map,
        lane_ids=lane_ids,
        surroundings=surroundings,
        kind=np.array([trip.person.body.kind for trip in trips], np.int64),
        size_lwh_m=size_lwh_m,
        car=np.array([trip.person.body is BodyType.CAR for trip in trips]),
        bodies=bodies,
        begins_s=begins_s,
    )
