"""Plots of land along streets: parking lots, houses with driveways, buildings, nothing."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from infgen.geometry import to_local
from infgen.sources.towns.road_users import MOTOR_SHARES, BodyType, draw_size
from infgen.sources.towns.streets import curves
from infgen.sources.towns.streets.boxes import Boxes, meet
from infgen.sources.towns.streets.curves import Points
from infgen.sources.towns.streets.network import Edge
from infgen.sources.towns.streets.street_types import Rank, Street

CLEAR_M = 1.0
"""Nothing stands nearer to a road edge, but what is parked along it."""
_STALL_M = 2.75
"""Width of a stall in a parking lot."""
_AISLE_M = 11.5
_BUILDING_HEIGHT_M = 6.0
_PLOT_REACH_M = 75.0
"""Nothing built on a plot is farther from the middle of its street side."""
_LARGEST_M = 40.0
"""Boxes whose middles are farther apart do not meet."""


@dataclass(frozen=True, slots=True)
class SurroundingsDensity:
    """How much stands beside the roads of a town.

    Attributes:
        lots: Share of the plots that are parking lots.
        houses: Share of the plots with a house and a driveway.
        blocks: Share of the plots with a building alone.
        taken: Share of the stalls and driveways in use.
        people_per_km: Who stands, on every kilometre of pavement.
    """

    lots: float
    houses: float
    blocks: float
    taken: float
    people_per_km: float


@dataclass
class Plot:
    """Land beside a street: its street side as a pose looking away, and its size."""

    pose: Float64[np.ndarray, "3"]
    wide_m: float
    pavement_m: float


def draw_plenty(rng: np.random.Generator) -> SurroundingsDensity:
    """Draw how much stands beside the roads."""
    lots, houses, blocks, _ = rng.dirichlet([1.2, 4.0, 3.0, 2.0])
    return SurroundingsDensity(
        lots=float(lots),
        houses=float(houses),
        blocks=float(blocks),
        taken=float(rng.uniform(0.15, 0.7)),
        people_per_km=float(np.exp(rng.uniform(np.log(0.3), np.log(8.0)))),
    )


class Site:
    """What has been built so far, and where roads are."""

    def __init__(self, roads_m: Points) -> None:
        self.walls: list[np.ndarray] = []
        self.parked: list[np.ndarray] = []
        self._roads_m = self._near_m = roads_m
        self._boxes = np.empty((256, 6))
        self._count = 0

    def approach(self, plot: Plot) -> None:
        """Look at the roads near a plot only."""
        away_m = np.abs(self._roads_m - plot.pose[:2]).max(axis=1)
        self._near_m = self._roads_m[away_m < _PLOT_REACH_M]

    def put(self, boxes: Boxes, among: list[np.ndarray]) -> int:
        """Build those boxes that are free, of two that meet the first; say how many."""
        free = boxes[~self._on_road(boxes)]
        free = free[~meet(free, self._around(free)).any(axis=1)]
        free = free[~np.tril(meet(free, free), -1).any(axis=1)]
        among.extend(free)
        while self._count + len(free) > len(self._boxes):
            self._boxes = np.concatenate([self._boxes, np.empty_like(self._boxes)])
        self._boxes[self._count : self._count + len(free)] = free
        self._count += len(free)
        return len(free)

    def _on_road(self, boxes: Boxes) -> Bool[np.ndarray, " box"]:
        points = np.pad(self._near_m, ((0, 0), (0, 1)))
        inside = np.abs(to_local(points[None], boxes[:, None, :3]))[..., :2]
        covered = (inside < boxes[:, None, 3:5] / 2 + CLEAR_M).all(axis=-1)
        return np.asarray(covered.any(axis=1))

    def _around(self, boxes: Boxes) -> Boxes:
        """What is built so near that boxes could meet it."""
        others = self._boxes[: self._count]
        if not len(boxes):
            return others[:0]
        low_m, high_m = boxes[:, :2].min(axis=0), boxes[:, :2].max(axis=0)
        near = (others[:, :2] > low_m - _LARGEST_M) & (others[:, :2] < high_m + _LARGEST_M)
        return others[near.all(axis=1)]


def cut_plots(
    edge: Edge, street: Street, rng: np.random.Generator
) -> Iterator[tuple[float, Plot]]:
    """Cut the land right of a street into plots; each has its middle on the road edge."""
    kerb_m = edge.kerb()
    total_m = curves.length(kerb_m)
    heading_rad, known_m = curves.headings(kerb_m), curves.arc_lengths(kerb_m)
    widest_m = 34.0 if street.rank > Rank.LOCAL else 24.0
    start_m = 6.0
    while True:
        wide_m = float(rng.uniform(11.0, widest_m))
        along_m = start_m + wide_m / 2
        start_m += wide_m + float(rng.uniform(0.5, 6.0))
        if start_m > total_m - 4.0:
            return
        x_m, y_m = curves.points_at(kerb_m, np.array([along_m]))[0]
        facing_rad = float(np.interp(along_m, known_m, heading_rad)) - np.pi / 2
        yield along_m, Plot(np.array([x_m, y_m, facing_rad]), wide_m, street.pavement_m)


def build_on(
    plot: Plot, plenty: SurroundingsDensity, site: Site, rng: np.random.Generator
) -> Points | None:
    """Build on a plot; return the outline of its driveway, if it has one."""
    drawn = rng.random()
    if drawn < plenty.lots:
        return _park_lot(plot, plenty.taken, site, rng)
    if drawn < plenty.lots + plenty.houses:
        return _build_house(plot, plenty.taken, site, rng)
    if drawn < plenty.lots + plenty.houses + plenty.blocks:
        deep_m, back_m = float(rng.uniform(9.0, 16.0)), float(rng.uniform(0.5, 5.0))
        site.put(_wall(plot, 0.0, back_m, (plot.wide_m, deep_m)), site.walls)
    return None


def _wall(plot: Plot, left_m: float, back_m: float, size_m: tuple[float, float]) -> Boxes:
    """A building so far behind the pavement: width along the street, and depth."""
    wide_m, deep_m = size_m
    pose = _at(plot, plot.pavement_m + back_m + deep_m / 2, left_m, 0.0)
    return np.array([[*pose, deep_m, wide_m, _BUILDING_HEIGHT_M]])


def _at(plot: Plot, away_m: float, left_m: float, turn_rad: float) -> np.ndarray:
    """Pose on a plot: so far away from the road edge, so far left of its middle."""
    x_m, y_m, facing_rad = plot.pose
    cos, sin = np.cos(facing_rad), np.sin(facing_rad)
    return np.array(
        [
            x_m + away_m * cos - left_m * sin,
            y_m + away_m * sin + left_m * cos,
            facing_rad + turn_rad,
        ]
    )


def _build_house(
    plot: Plot, taken: float, site: Site, rng: np.random.Generator
) -> Points | None:
    """Build a house and, beside it, a driveway with room for two cars."""
    side = float(rng.choice([-1.0, 1.0]))
    drive_m = side * (plot.wide_m / 2 - 1.8)
    house_m = (max(plot.wide_m - 4.5, 5.0), float(rng.uniform(8.0, 13.0)))
    back_m = float(rng.uniform(3.0, 7.0))
    if not site.put(_wall(plot, -side * 2.2, back_m, house_m), site.walls):
        return None
    away_m = plot.pavement_m + 0.6
    for _ in range(2):
        if rng.random() < taken:
            length_m, width_m, height_m = draw_size(BodyType.CAR, rng)
            turn_rad = float(rng.choice([0.0, np.pi])) + float(rng.normal(0.0, 0.03))
            left_m = drive_m + float(rng.normal(0.0, 0.12))
            pose = _at(plot, away_m + length_m / 2, left_m, turn_rad)
            site.put(np.array([[*pose, length_m, width_m, height_m]]), site.parked)
        away_m += 6.2
    return _driveway(plot, drive_m, 3.2)


def _park_lot(
    plot: Plot, taken: float, site: Site, rng: np.random.Generator
) -> Points | None:
    """Fill rows of stalls side by side, and let a driveway lead to them."""
    num_rows = int(rng.integers(1, 4))
    stalls = int(plot.wide_m // _STALL_M)
    away_m = plot.pavement_m + float(rng.uniform(1.0, 4.0)) + 2.6
    rows: list[list[float]] = []
    for row in range(num_rows):
        turned = float(rng.choice([0.0, np.pi]))
        for stall in range(stalls):
            if rng.random() > taken:
                continue
            left_m = (stall - (stalls - 1) / 2) * _STALL_M + float(rng.normal(0.0, 0.1))
            slip_m = float(rng.normal(0.0, 0.25))
            turn_rad = turned + float(rng.normal(0.0, 0.025))
            pose = _at(plot, away_m + slip_m, left_m, turn_rad)
            rows.append([*pose, *draw_size(_parked_body(rng), rng)])
        away_m += 5.9 if row % 2 else _AISLE_M
    site.put(np.array(rows).reshape(-1, 6), site.parked)
    return _driveway(plot, float(rng.uniform(-0.3, 0.3)) * plot.wide_m, 6.0)


def _parked_body(rng: np.random.Generator) -> BodyType:
    """Mostly cars, now and then a van."""
    return BodyType.VAN if rng.random() < MOTOR_SHARES[BodyType.VAN] else BodyType.CAR


def _driveway(plot: Plot, left_m: float, wide_m: float) -> Points:
    away_m = plot.pavement_m + 0.5
    return np.array(
        [
            _at(plot, away, left_m + side * wide_m / 2, 0.0)[:2]
            for away, side in ((0.0, 1), (0.0, -1), (away_m, -1), (away_m, 1))
        ]
    )
