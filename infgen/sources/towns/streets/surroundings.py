"""What stands beside the road: buildings that hide, parked cars, driveways, people."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from infgen.scene import AgentType
from infgen.sources.towns.road_users import BodyType, draw_size
from infgen.sources.towns.streets import curves
from infgen.sources.towns.streets.boxes import Boxes
from infgen.sources.towns.streets.curves import Points
from infgen.sources.towns.streets.network import Edge, Network, Use
from infgen.sources.towns.streets.plots import (
    Site,
    SurroundingsDensity,
    build_on,
    cut_plots,
)
from infgen.sources.towns.streets.street_types import Street

_KERB_SPACING_M = 3.0
_FREE_ENDS_M = 9.0
"""Nobody parks so near to a junction."""
_PITCH_M = (5.9, 7.4)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """All that stands still.

    Attributes:
        walls: Buildings.
        parked: Cars, vans and trucks without a driver.
        people: Who stands on the pavement.
        driveways: Outlines, from the road edge to the plot.
    """

    walls: Boxes
    parked: Boxes
    people: Boxes
    driveways: tuple[Points, ...]


def surround(
    network: Network,
    streets: dict[str, Street],
    plenty: SurroundingsDensity,
    rng: np.random.Generator,
) -> Surroundings:
    """Build on the plots along all streets, and park cars."""
    kerbs_m = [
        curves.resample(edge.kerb(), _KERB_SPACING_M) for edge in network.edges.values()
    ]
    site = Site(np.concatenate(kerbs_m))
    driveways: list[Points] = []
    openings: dict[str, list[float]] = {}
    for name, street in streets.items():
        openings[name] = []
        for along_m, plot in cut_plots(network.edges[name], street, rng):
            site.approach(plot)
            entry = build_on(plot, plenty, site, rng)
            if entry is not None:
                driveways.append(entry)
                openings[name].append(along_m)
    kerbside = [
        _along_kerb(network.edges[name], street, openings[name], rng)
        for name, street in streets.items()
    ]
    people = [
        _on_pavement(network.edges[name], plenty.people_per_km, rng) for name in streets
    ]
    return Surroundings(
        walls=np.array(site.walls).reshape(-1, 6),
        parked=np.concatenate([np.array(site.parked).reshape(-1, 6), *kerbside]),
        people=np.concatenate(people),
        driveways=tuple(driveways),
    )


def _along_kerb(
    edge: Edge, street: Street, openings_m: list[float], rng: np.random.Generator
) -> Boxes:
    """Park cars along a road edge where there is room for them, driveways left free."""
    strip = edge.outer
    length_m = curves.length(strip.xy_m)
    if street.parking_m <= 0 or strip.use is not Use.NO_USE:
        return np.empty((0, 6))
    rows, at_m = [], _FREE_ENDS_M + float(rng.uniform(0.0, 6.0))
    heading_rad, known_m = curves.headings(strip.xy_m), curves.arc_lengths(strip.xy_m)
    while at_m < length_m - _FREE_ENDS_M - 4.0:
        free = all(abs(at_m - opening_m) > 5.5 for opening_m in openings_m)
        if free and rng.random() < street.taken:
            x_m, y_m = curves.points_at(strip.xy_m, np.array([at_m]))[0]
            along_rad = float(np.interp(at_m, known_m, heading_rad))
            aside_m = float(np.clip(rng.normal(-0.05, 0.08), -0.2, 0.1))
            size_m = np.minimum(
                draw_size(BodyType.CAR, rng), [5.6, street.parking_m - 0.1, 9.0]
            )
            rows.append(
                [
                    x_m - aside_m * np.sin(along_rad),
                    y_m + aside_m * np.cos(along_rad),
                    along_rad + float(rng.normal(0.0, 0.015)),
                    *size_m,
                ]
            )
        at_m += float(rng.uniform(*_PITCH_M))
    return np.array(rows).reshape(-1, 6)


def _on_pavement(edge: Edge, per_km: float, rng: np.random.Generator) -> Boxes:
    """Let people stand on a pavement, alone or in twos and threes."""
    lane = edge.lanes[0]
    length_m = curves.length(lane.xy_m)
    rows: list[list[float]] = []
    if lane.use is not Use.WALKERS:
        return np.empty((0, 6))
    for _ in range(int(rng.poisson(per_km * length_m / 1000.0 / 1.5))):
        x_m, y_m = curves.points_at(lane.xy_m, rng.uniform(0.0, length_m, 1))[0]
        for _ in range(int(rng.choice([1, 2, 3], p=[0.65, 0.25, 0.1]))):
            shift_m = rng.uniform(-1.3, 1.3, 2)
            heading_rad = float(rng.uniform(-np.pi, np.pi))
            size_m = draw_size(BodyType.WALKER, rng)
            rows.append([x_m + shift_m[0], y_m + shift_m[1], heading_rad, *size_m])
    return np.array(rows).reshape(-1, 6)


def kinds_of(surroundings: Surroundings) -> Int64[np.ndarray, " thing"]:
    """``AgentType`` of parked cars, then of people."""
    parked = np.full(len(surroundings.parked), AgentType.VEHICLE, np.int64)
    people = np.full(len(surroundings.people), AgentType.PEDESTRIAN, np.int64)
    return np.concatenate([parked, people])


def within(
    boxes: Boxes, eye_m: Float64[np.ndarray, "step 2"], reach_m: float
) -> Bool[np.ndarray, " box"]:
    """Which boxes come within reach of an eye on its way."""
    low_m, high_m = eye_m.min(axis=0) - reach_m, eye_m.max(axis=0) + reach_m
    return ((boxes[:, :2] > low_m) & (boxes[:, :2] < high_m)).all(axis=1)
