"""Who sets out: road users, their routes, sizes and habits, from a random stream."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float64, Int64

from infgen.scene import AgentKind
from infgen.sources.towns.routes import Routes
from infgen.sources.towns.town import Town

TRUCK_SHARE = 0.07


@dataclass(frozen=True, slots=True)
class Users:
    """Road users, in the order in which they set out from each source.

    Attributes:
        kind: ``AgentKind``.
        route: Row of the routes.
        start_s: When they appear; those of 0 are under way when time begins.
        start_m: Where on the route.
        size_lwh_m: Of their boxes.
        haste: Their wished speed as a share of the limit.
        headway_s: Time they keep to whoever is ahead.
        accel_mps2: How hard they accelerate at most.
        side_m: How far left of their path they keep.
        sway_m: How far they weave about it.
        sway_length_m: From one weave to the next, the first from ``sway_phase_rad`` on.
    """

    kind: Int64[np.ndarray, " user"]
    route: Int64[np.ndarray, " user"]
    start_s: Float64[np.ndarray, " user"]
    start_m: Float64[np.ndarray, " user"]
    size_lwh_m: Float64[np.ndarray, "user 3"]
    haste: Float64[np.ndarray, " user"]
    headway_s: Float64[np.ndarray, " user"]
    accel_mps2: Float64[np.ndarray, " user"]
    side_m: Float64[np.ndarray, " user"]
    sway_m: Float64[np.ndarray, " user"]
    sway_length_m: Float64[np.ndarray, " user"]
    sway_phase_rad: Float64[np.ndarray, " user"]

    def __len__(self) -> int:
        return len(self.kind)

    def only(self, rows: np.ndarray) -> "Users":
        """Keep some, in the given order."""
        return Users(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


@dataclass(frozen=True, slots=True)
class _Trip:
    route: int
    start_s: float
    start_m: float


def draw_users(
    town: Town, routes: Routes, seconds: float, rng: np.random.Generator
) -> Users:
    """Draw everyone who is under way at time 0 or sets out within so many seconds."""
    pace_mps = {AgentKind.VEHICLE: 10.0, AgentKind.CYCLIST: 4.5, AgentKind.PEDESTRIAN: 1.3}
    per_hour = {
        AgentKind.VEHICLE: rng.uniform(180.0, 780.0),
        AgentKind.CYCLIST: rng.uniform(60.0, 240.0),
        AgentKind.PEDESTRIAN: rng.uniform(5.0, 70.0),
    }
    trips: list[_Trip] = []
    for strip, lane in enumerate(town.strips):
        gap_m = 3600 * pace_mps[lane.kind] / per_hour[lane.kind]
        if lane.gate is None:
            trips += _under_way(routes, strip, gap_m, rng)
        if strip in town.sources:
            gap_s = 3600 / per_hour[lane.kind]
            trips += _arrivals(routes, strip, gap_s, seconds, rng)
    return _people(routes, trips, rng)


def _under_way(
    routes: Routes, strip: int, gap_m: float, rng: np.random.Generator
) -> list[_Trip]:
    """Spread users over a strip as they would be after long traffic."""
    through = np.flatnonzero(np.isfinite(routes.start_m[:, strip]))
    if not len(through):
        return []
    length_m = routes.end_m[through[0], strip] - routes.start_m[through[0], strip]
    # Nobody starts so near the end that a red light could not stop them any more.
    at_m, trips = rng.exponential(gap_m), []
    walking = routes.kind[through[0]] == AgentKind.PEDESTRIAN
    margin_m, room_m = (1.0, 2.0) if walking else (30.0, 14.0)
    while at_m < length_m - margin_m:
        route = _choose(routes, through, rng)
        trips.append(_Trip(route, 0.0, routes.start_m[route, strip] + at_m))
        at_m += room_m + rng.exponential(gap_m)
    return trips


def _arrivals(
    routes: Routes, strip: int, gap_s: float, seconds: float, rng: np.random.Generator
) -> list[_Trip]:
    """Let users set out from the start of a strip at random times."""
    starting = routes.starting_with(strip)
    if not len(starting):
        return []
    trips, time_s = [], rng.exponential(gap_s)
    while time_s < seconds:
        trips.append(_Trip(_choose(routes, starting, rng), max(time_s, 0.1), 0.0))
        time_s += 1.5 + rng.exponential(gap_s)
    return trips


def _choose(
    routes: Routes, among: Int64[np.ndarray, " route"], rng: np.random.Generator
) -> int:
    """Choose a route, straighter ones rather."""
    weight = 1 / (0.6 + np.abs(routes.turn_rad[among]))
    return int(rng.choice(among, p=weight / weight.sum()))


def _people(routes: Routes, trips: list[_Trip], rng: np.random.Generator) -> Users:
    route = np.array([trip.route for trip in trips], np.int64)
    kind = routes.kind[route]
    size_lwh_m = _sizes(kind, rng)
    start_s = np.array([trip.start_s for trip in trips])
    start_m = np.array([trip.start_m for trip in trips])
    start_m = np.maximum(start_m, size_lwh_m[:, 0] / 2 + 0.1)
    count = len(trips)
    walking, cycling = kind == AgentKind.PEDESTRIAN, kind == AgentKind.CYCLIST
    return Users(
        kind=kind,
        route=route,
        start_s=start_s,
        start_m=start_m,
        size_lwh_m=size_lwh_m,
        haste=_by_kind(kind, rng, (0.78, 1.12), (0.42, 0.75), (0.3, 0.85)),
        headway_s=_by_kind(kind, rng, (0.9, 1.9), (0.8, 1.4), (0.4, 0.8)),
        accel_mps2=_by_kind(kind, rng, (1.1, 2.3), (0.6, 1.1), (0.6, 1.2)),
        side_m=rng.normal(0.0, 1.0, count) * np.where(walking, 0.14, 0.12),
        sway_m=_by_kind(kind, rng, (0.02, 0.12), (0.03, 0.1), (0.01, 0.04)),
        sway_length_m=np.where(
            walking, 1.4, np.where(cycling, 9.0, rng.uniform(60, 120, count))
        ),
        sway_phase_rad=rng.uniform(0.0, 2 * np.pi, count),
    ).only(np.argsort(start_s, kind="stable"))


def _by_kind(
    kind: Int64[np.ndarray, " user"], rng: np.random.Generator, *ranges: tuple[float, float]
) -> Float64[np.ndarray, " user"]:
    """Draw uniformly from the range of each user's kind: vehicle, pedestrian, cyclist."""
    lowest, highest = np.array([ranges[0], ranges[2], ranges[1]])[kind].T
    return rng.uniform(lowest, highest)


def _sizes(
    kind: Int64[np.ndarray, " user"], rng: np.random.Generator
) -> Float64[np.ndarray, "user 3"]:
    """Draw boxes: length, width, height."""
    mean = np.array([[4.7, 1.9, 1.65], [0.8, 0.72, 1.72], [1.8, 0.75, 1.75]])[kind]
    spread = np.array([[0.3, 0.08, 0.15], [0.1, 0.08, 0.1], [0.1, 0.08, 0.08]])[kind]
    size_lwh_m = mean + spread * np.clip(rng.normal(size=mean.shape), -2.0, 2.0)
    truck = (kind == AgentKind.VEHICLE) & (rng.random(len(kind)) < TRUCK_SHARE)
    long_m = rng.uniform([6.2, 2.2, 2.6], [7.6, 2.4, 3.3], size=mean.shape)
    return np.where(truck[:, None], long_m, size_lwh_m)
