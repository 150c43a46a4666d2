"""Street types: widths, speed limits, and what lies between the lanes and the road edge."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from infgen.sources.towns.variety import BASIC, StreetVariety

MPS_PER_MPH = 0.44704
CURB_M = 0.3
"""What lies between the outermost lane and the road edge where nothing else does."""


class Rank(IntEnum):
    """How important a street is; where two meet, the lower one waits."""

    LOCAL = 1
    COLLECTOR = 2
    ARTERIAL = 3


@dataclass(frozen=True, slots=True)
class Street:
    """What a street looks like all along. Widths are of one side.

    Attributes:
        rank: Its importance.
        num_lanes: Lanes each way.
        lane_m: Width of a lane.
        limit_mph: Speed limit.
        median_m: Half of the island between the directions; 0 without one.
        bike_m: Bicycle lane; 0 without one.
        parking_m: Room for parked cars along the road edge; 0 without any.
        pavement_m: Pavement beyond the road edge.
        lined: Whether opposite lanes are kept apart by a painted line.
        taken: Share of the parking room that is taken.
    """

    rank: Rank
    num_lanes: int
    lane_m: float
    limit_mph: float
    median_m: float
    bike_m: float
    parking_m: float
    pavement_m: float
    lined: bool
    taken: float

    @property
    def limit_mps(self) -> float:
        """Speed limit in metres per second."""
        return self.limit_mph * MPS_PER_MPH

    @property
    def half_m(self) -> float:
        """From the middle of the street to the road edge."""
        lanes_m = self.num_lanes * self.lane_m
        return self.median_m + lanes_m + self.bike_m + self.parking_m


def draw_street(
    rank: Rank, rng: np.random.Generator, variety: StreetVariety = BASIC.streets
) -> Street:
    """Draw a street of a rank."""
    match rank:
        case Rank.ARTERIAL:
            return _arterial(rng, variety)
        case Rank.COLLECTOR:
            return _collector(rng, variety)
        case _:
            return _local(rng)


def _arterial(rng: np.random.Generator, variety: StreetVariety) -> Street:
    return Street(
        rank=Rank.ARTERIAL,
        num_lanes=_num_lanes(variety.arterial_lanes, rng),
        lane_m=float(rng.uniform(3.3, 3.6)),
        limit_mph=float(rng.choice(variety.arterial_limits_mph)),
        median_m=float(rng.uniform(0.8, 1.6)) if rng.random() < 0.45 else 0.0,
        bike_m=float(rng.uniform(1.5, 1.9)) if rng.random() < 0.25 else 0.0,
        parking_m=2.3 if rng.random() < 0.1 else 0.0,
        pavement_m=float(rng.uniform(2.0, 3.5)),
        lined=True,
        taken=float(rng.uniform(0.1, 0.6)),
    )


def _collector(rng: np.random.Generator, variety: StreetVariety) -> Street:
    return Street(
        rank=Rank.COLLECTOR,
        num_lanes=_num_lanes(variety.collector_lanes, rng),
        lane_m=float(rng.uniform(3.1, 3.5)),
        limit_mph=float(rng.choice([30, 35, 40])),
        median_m=0.0,
        bike_m=float(rng.uniform(1.4, 1.8)) if rng.random() < 0.25 else 0.0,
        parking_m=float(rng.uniform(2.2, 2.5)) if rng.random() < 0.45 else 0.0,
        pavement_m=float(rng.uniform(1.8, 3.0)),
        lined=True,
        taken=float(rng.uniform(0.2, 0.9)),
    )


def _local(rng: np.random.Generator) -> Street:
    return Street(
        rank=Rank.LOCAL,
        num_lanes=1,
        lane_m=float(rng.uniform(2.9, 3.3)),
        limit_mph=float(rng.choice([20, 25])),
        median_m=0.0,
        bike_m=0.0,
        parking_m=float(rng.uniform(2.1, 2.4)) if rng.random() < 0.8 else 0.0,
        pavement_m=float(rng.uniform(1.5, 2.4)),
        lined=bool(rng.random() < 0.25),
        taken=float(rng.uniform(0.3, 0.95)),
    )


def _num_lanes(shares: Mapping[int, float], rng: np.random.Generator) -> int:
    return int(rng.choice(list(shares), p=list(shares.values())))
