"""How much towns differ from each other: the ranges that all about them is drawn from.

``BASIC`` is what the records and the weights of the package were made with; its scenes keep
their bytes. ``BROAD`` has more layouts, demands and drivers, and vehicles that park. In
``RECOVERY`` some drivers have not looked ahead as a scene begins, and recover from it. In
``STEADY`` what a car does next does not decide whether it records.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum

Range = tuple[float, float]


class Pattern(Enum):
    """How the streets of a town lie."""

    GRID = "grid"
    SPIDER = "spider"
    RANDOM = "random"
    T_JUNCTIONS = "t-junctions"
    CURVED_GRID = "curved grid"


class CarFollowing(Enum):
    """Car-following models. Values are SUMO's names.

    IDM: the intelligent driver model (Treiber et al. 2000). Krauss: the fastest speed that
    is safe, with errors of the driver (Krauss 1998). EIDM: IDM with reaction and estimation
    errors, and smooth starts (Salles et al. 2020).
    """

    IDM = "IDM"
    KRAUSS = "Krauss"
    EIDM = "EIDM"


@dataclass(frozen=True, slots=True)
class Inattention:
    """Drivers who do not look ahead at times.

    They hold a speed of their own, whatever stands ahead, until they look again. Times are
    in steps of the simulation, and a recording begins at every ``period_steps``.

    Attributes:
        period_steps: From one time to the next.
        before_steps: So long before a recording begins, drivers are drawn who do not look.
        until_steps: So long after it has begun, all look again.
        share: Of all drivers, each time.
        steps: How long one does not look: least and most.
        brake_mps2: One looks up in time to brake so hard for who is ahead, or for a light.
    """

    period_steps: int
    before_steps: int
    until_steps: int
    share: float
    steps: tuple[int, int]
    brake_mps2: Range


@dataclass(frozen=True, slots=True)
class StreetVariety:
    """Ranges of streets.

    Attributes:
        patterns: Share of the towns of each pattern.
        block_m: Sides of the blocks of a grid.
        bend: How far streets bulge, as a share of their length: spread and most.
        one_way: Largest share of the streets of a town that are one-way.
        free_bend_deg: How far one may turn at a junction without slowing down.
        mixed_controls: Whether each town prefers some kinds of junctions to others.
        arterial_lanes: Shares of arterials by lanes each way.
        collector_lanes: The same of collectors.
        arterial_limits_mph: Speed limits of arterials, all as often.
    """

    patterns: Mapping[Pattern, float]
    block_m: Range
    bend: Range
    one_way: float
    free_bend_deg: float
    mixed_controls: bool
    arterial_lanes: Mapping[int, float]
    collector_lanes: Mapping[int, float]
    arterial_limits_mph: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class DriverVariety:
    """Ranges of drivers.

    Attributes:
        car_following: Share of the drivers of each model.
        haste: Wished speed as a share of the limit: mean, standard deviation.
        haste_limits: Least and most of it.
        headway_s: Time kept to who is ahead.
        own_manners: Whether drivers differ in car-following model and in how they change
            lanes.
        inattention: Who does not look ahead, and when; None if all do.
    """

    car_following: Mapping[CarFollowing, float]
    haste: Range
    haste_limits: Range
    headway_s: Range
    own_manners: bool
    inattention: Inattention | None = None


@dataclass(frozen=True, slots=True)
class DemandVariety:
    """Ranges of demand.

    Attributes:
        cars_per_km: On every kilometre of a collector's lane at the beginning.
        walkers_per_km: On every kilometre of pavement.
        parking: Largest share of a town's cars that park on their way or pull out.
    """

    cars_per_km: Range
    walkers_per_km: Range
    parking: float


@dataclass(frozen=True, slots=True)
class Variety:
    """Ranges that towns are drawn from.

    Attributes:
        name: As on the command line.
        scenes_per_town: Recorded in each town: other cars, other times.
        streets: Of streets.
        drivers: Of drivers.
        demand: Of demand.
        at_any_time: Whether a car is recorded at any time of its drive alike, and not
            rather where it goes far in the next half minute.
    """

    name: str
    scenes_per_town: int
    streets: StreetVariety
    drivers: DriverVariety
    demand: DemandVariety
    at_any_time: bool = False


BASIC = Variety(
    name="basic",
    scenes_per_town=10,
    streets=StreetVariety(
        patterns={Pattern.GRID: 0.35, Pattern.SPIDER: 0.15, Pattern.RANDOM: 0.5},
        block_m=(85.0, 170.0),
        bend=(0.035, 0.08),
        one_way=0.0,
        free_bend_deg=15.0,
        mixed_controls=False,
        arterial_lanes={2: 0.75, 3: 0.25},
        collector_lanes={1: 0.75, 2: 0.25},
        arterial_limits_mph=(40, 45, 50),
    ),
    drivers=DriverVariety(
        car_following={CarFollowing.IDM: 1.0},
        haste=(0.98, 0.11),
        haste_limits=(0.7, 1.3),
        headway_s=(0.9, 1.8),
        own_manners=False,
    ),
    demand=DemandVariety(cars_per_km=(2.5, 14.0), walkers_per_km=(0.2, 8.0), parking=0.0),
)
BROAD = Variety(
    name="broad",
    scenes_per_town=5,
    streets=StreetVariety(
        patterns={
            Pattern.GRID: 0.2,
            Pattern.SPIDER: 0.15,
            Pattern.RANDOM: 0.3,
            Pattern.T_JUNCTIONS: 0.15,
            Pattern.CURVED_GRID: 0.2,
        },
        block_m=(75.0, 220.0),
        bend=(0.055, 0.11),
        one_way=0.3,
        free_bend_deg=4.0,
        mixed_controls=True,
        arterial_lanes={1: 0.1, 2: 0.5, 3: 0.3, 4: 0.1},
        collector_lanes={1: 0.6, 2: 0.35, 3: 0.05},
        arterial_limits_mph=(35, 40, 45, 50),
    ),
    drivers=DriverVariety(
        car_following={
            CarFollowing.IDM: 0.4,
            CarFollowing.KRAUSS: 0.3,
            CarFollowing.EIDM: 0.3,
        },
        haste=(0.99, 0.13),
        haste_limits=(0.65, 1.3),
        headway_s=(0.8, 2.4),
        own_manners=True,
    ),
    demand=DemandVariety(cars_per_km=(1.0, 24.0), walkers_per_km=(0.2, 16.0), parking=0.4),
)
RECOVERY = replace(
    BASIC,
    name="recovery",
    drivers=replace(
        BASIC.drivers,
        inattention=Inattention(
            period_steps=80,
            before_steps=8,
            until_steps=10,  # The history that a network is given ends there.
            share=0.35,
            steps=(6, 16),
            brake_mps2=(2.0, 4.5),
        ),
    ),
)
STEADY = replace(BASIC, name="steady", at_any_time=True)
VARIETIES = {each.name: each for each in (BASIC, BROAD, RECOVERY, STEADY)}
"""By name, the default first."""
