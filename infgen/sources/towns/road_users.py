"""Bodies of road users: what they are, how large, and how they drive."""

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from infgen.scene import AgentType
from infgen.sources.towns.variety import BASIC, CarFollowing, DriverVariety


class BodyType(Enum):
    """What somebody is or drives. Values are SUMO's vehicle classes."""

    CAR = "passenger"
    VAN = "delivery"
    TRUCK = "truck"
    BUS = "bus"
    MOTORCYCLE = "motorcycle"
    BICYCLE = "bicycle"
    WALKER = "pedestrian"

    @property
    def kind(self) -> AgentType:
        """What a log calls it."""
        kinds = {BodyType.BICYCLE: AgentType.CYCLIST, BodyType.WALKER: AgentType.PEDESTRIAN}
        return kinds.get(self, AgentType.VEHICLE)


MOTOR_SHARES = {
    BodyType.CAR: 0.885,
    BodyType.VAN: 0.05,
    BodyType.TRUCK: 0.035,
    BodyType.BUS: 0.012,
    BodyType.MOTORCYCLE: 0.018,
}
_MEAN_LWH_M = {
    BodyType.CAR: (4.75, 2.06, 1.68),
    BodyType.VAN: (6.1, 2.3, 2.5),
    BodyType.TRUCK: (8.4, 2.65, 3.3),
    BodyType.BUS: (11.8, 2.9, 3.2),
    BodyType.MOTORCYCLE: (2.2, 0.95, 1.6),
    BodyType.BICYCLE: (1.76, 0.82, 1.74),
    BodyType.WALKER: (0.9, 0.86, 1.72),
}
_SPREAD_LWH_M = {
    BodyType.CAR: (0.38, 0.11, 0.17),
    BodyType.VAN: (0.5, 0.1, 0.25),
    BodyType.TRUCK: (1.2, 0.15, 0.4),
    BodyType.BUS: (0.6, 0.1, 0.15),
    BodyType.MOTORCYCLE: (0.1, 0.08, 0.1),
    BodyType.BICYCLE: (0.08, 0.05, 0.08),
    BodyType.WALKER: (0.1, 0.09, 0.1),
}


@dataclass(frozen=True, slots=True)
class LaneChanging:
    """How a driver changes lanes; 1 is SUMO's default of the first three.

    Attributes:
        speed_gain: Eagerness to overtake.
        cooperation: Readiness to let others in.
        assertiveness: Readiness to accept small gaps.
        keep_right: Eagerness to go back to the right lane.
        lateral_mps: Highest lateral speed.
    """

    speed_gain: float = 1.0
    cooperation: float = 1.0
    assertiveness: float = 1.0
    keep_right: float = 1.0
    lateral_mps: float = 0.8


@dataclass(frozen=True, slots=True)
class RoadUser:
    """Somebody on the road.

    Attributes:
        body: What they are or drive.
        size_lwh_m: Box around it.
        haste: Wished speed, as a share of the limit (of walkers: in metres per second).
        headway_s: Time they keep to who is ahead.
        accel_mps2: How hard they speed up.
        brake_mps2: How hard they like to brake.
        aside_m: How far left of the middle of their lane they like to be.
        hesitation_s: How long after they could they set off, if they have stood.
        car_following: Model of how they follow.
        imperfection: Of drivers by Krauss's model: how far they fall short of the speed
            that they could have, as a share of a step's acceleration.
        gap_m: Least distance to who is ahead.
        lane_changing: How they change lanes.
    """

    body: BodyType
    size_lwh_m: tuple[float, float, float]
    haste: float
    headway_s: float
    accel_mps2: float
    brake_mps2: float
    aside_m: float
    hesitation_s: float
    car_following: CarFollowing = CarFollowing.IDM
    imperfection: float = 0.0
    gap_m: float = 2.0
    lane_changing: LaneChanging = LaneChanging()


def draw_motorist(
    rng: np.random.Generator, variety: DriverVariety = BASIC.drivers
) -> RoadUser:
    """Draw a driver and what they drive."""
    bodies = list(MOTOR_SHARES)
    body = bodies[rng.choice(len(bodies), p=list(MOTOR_SHARES.values()))]
    heavy = body in (BodyType.TRUCK, BodyType.BUS)
    person = RoadUser(
        body=body,
        size_lwh_m=draw_size(body, rng),
        haste=float(np.clip(rng.normal(*variety.haste), *variety.haste_limits)),
        headway_s=float(rng.uniform(*variety.headway_s)),
        accel_mps2=float(rng.uniform(0.9, 1.4) if heavy else rng.uniform(1.3, 2.9)),
        brake_mps2=float(rng.uniform(1.8, 2.6) if heavy else rng.uniform(1.9, 3.4)),
        aside_m=float(np.clip(rng.normal(0.0, 0.16), -0.35, 0.35)),
        hesitation_s=draw_hesitation(rng),
    )
    return _with_manner(person, variety, rng) if variety.own_manners else person


def _with_manner(
    person: RoadUser, variety: DriverVariety, rng: np.random.Generator
) -> RoadUser:
    """Draw a driver's models of following and of changing lanes."""
    models = list(variety.car_following)
    shares = list(variety.car_following.values())
    return replace(
        person,
        car_following=models[rng.choice(len(models), p=shares)],
        imperfection=float(rng.uniform(0.0, 0.5)),
        gap_m=float(rng.uniform(1.5, 3.0)),
        lane_changing=LaneChanging(
            speed_gain=float(np.exp(rng.uniform(np.log(0.5), np.log(6.0)))),
            cooperation=float(rng.uniform(0.3, 1.0)),
            assertiveness=float(rng.uniform(0.8, 1.4)),
            keep_right=float(rng.uniform(0.0, 1.0)),
            lateral_mps=float(rng.uniform(0.7, 1.3)),
        ),
    )


def draw_cyclist(rng: np.random.Generator) -> RoadUser:
    """Draw somebody on a bicycle."""
    return RoadUser(
        body=BodyType.BICYCLE,
        size_lwh_m=draw_size(BodyType.BICYCLE, rng),
        haste=float(np.clip(rng.normal(4.9, 1.2), 2.5, 8.0)),
        headway_s=float(rng.uniform(0.8, 1.4)),
        accel_mps2=float(rng.uniform(0.7, 1.3)),
        brake_mps2=float(rng.uniform(1.5, 2.5)),
        aside_m=0.0,
        hesitation_s=draw_hesitation(rng),
        gap_m=1.0,
    )


def draw_walker(rng: np.random.Generator) -> RoadUser:
    """Draw somebody on foot."""
    return RoadUser(
        body=BodyType.WALKER,
        size_lwh_m=draw_size(BodyType.WALKER, rng),
        haste=float(np.clip(rng.normal(1.35, 0.25), 0.6, 2.4)),
        headway_s=1.0,
        accel_mps2=1.0,
        brake_mps2=1.5,
        aside_m=0.0,
        hesitation_s=0.0,
    )


def draw_hesitation(rng: np.random.Generator) -> float:
    """Draw how long somebody who may go takes to do so."""
    return float(min(rng.lognormal(np.log(0.7), 0.5), 2.5))


def draw_size(body: BodyType, rng: np.random.Generator) -> tuple[float, float, float]:
    """Draw a box: length, width, height, in whole millimetres as SUMO reads them."""
    noise = np.clip(rng.normal(size=3), -2.2, 2.2)
    # Some cars are pickups and large at that.
    if body is BodyType.CAR and rng.random() < 0.2:
        noise[0], noise[1:] = rng.uniform(1.5, 3.2), rng.uniform(0.8, 2.6, 2)
    size_m = np.array(_MEAN_LWH_M[body]) + noise * np.array(_SPREAD_LWH_M[body])
    length_m, width_m, height_m = np.round(size_m, 3).tolist()
    return length_m, width_m, height_m
