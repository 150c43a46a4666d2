"""The generator of traffic is nearest to its logs, in everything that engineers read."""

import numpy as np
import pytest

from infgen.metrics.proper.engineering.green import Greens
from infgen.metrics.proper.engineering.lanes import read_lanes
from infgen.metrics.proper.engineering.measure import SCALES, Place, measure
from infgen.metrics.proper.engineering.wasserstein import distance
from infgen.scene import FeatureType, LaneType
from tests.metrics.proper.roads import NOW, RADIUS_M, STEP_S, traffic

STEPS, GREEN = 202, 60
LINE_M, LANES = -6.0, 4
SCENES, ROLLOUTS = 16, 2
SPREAD = {"generator": 1.0, "collapsed": 0.0, "dispersed": 3.0}
"""How far every choice is from its mean, as a multiple of how far it should be."""


def choose(random, spread, mean, deviation, least):
    return np.maximum(mean + spread * deviation * random.normal(), least)


def turn_rad(random, spread):
    """Straight on mostly; the dispersed turn any way."""
    if spread > 1:
        return random.uniform(-3, 3)
    odds = [0.6, 0.2, 0.2] if spread else [1.0, 0.0, 0.0]
    return np.radians(random.choice([0.0, 90.0, -90.0], p=odds))


def drive(random, spread, start_m):
    """Way along the lane [step]: speeds vary, and red holds at the line until green."""
    mean_mps = choose(random, spread, 9.0, 2.0, 1.0)
    swing = choose(random, spread, 1.5, 0.5, 0.0)
    delay = int(choose(random, spread, 12, 5, 1))
    place_m, found = start_m, []
    for step in range(STEPS):
        held = place_m < LINE_M and step < GREEN + delay
        wanted_m = STEP_S * max(0.0, mean_mps + swing * np.sin(step / 5))
        moves_m = min(wanted_m, max(0.0, LINE_M - 0.5 - place_m)) if held else wanted_m
        found.append(place_m)
        place_m += moves_m
    return np.array(found)


def bend(way_m, lane_m, turned_rad):
    """Poses along the lane up to the origin, and beyond it in another direction."""
    beyond_m = np.maximum(way_m, 0)
    heading_rad = np.where(way_m > 0, turned_rad, 0)
    x_m = np.minimum(way_m, 0) + beyond_m * np.cos(turned_rad)
    y_m = lane_m + beyond_m * np.sin(turned_rad)
    return np.column_stack([x_m, y_m, heading_rad])


def simulate(random, spread):
    """Two vehicles in each of some lanes, and two that cross them."""
    paths = []
    for lane in range(LANES):
        way_m = drive(random, spread, choose(random, spread, -35, 10, -70))
        gap_m = choose(random, spread, 20, 6, 6)
        for behind_m in (0.0, gap_m):
            angle_rad = turn_rad(random, spread)
            paths.append(bend(way_m - behind_m, 4.0 * lane, angle_rad))
    for x_m in (-20.0, -26.0):
        speed_mps = choose(random, spread, 8.0, 1.5, 1.0)
        start_m = choose(random, spread, -40, 15, -70)
        y_m = start_m + speed_mps * STEP_S * np.arange(STEPS)
        paths.append(np.column_stack([np.full(STEPS, x_m), y_m, np.full(STEPS, np.pi / 2)]))
    return paths


@pytest.fixture(scope="module")
def place(build_map):
    x_m = np.linspace(-70, 0, 15)
    roads = [
        (
            lane,
            FeatureType.LANE,
            LaneType.SURFACE_STREET,
            np.column_stack([x_m, 0 * x_m + y_m]),
        )
        for lane, y_m in enumerate(4.0 * np.arange(LANES))
    ]
    green = np.full(LANES, GREEN - NOW - 1)
    stops_m = np.column_stack([np.full(LANES, LINE_M + 3), 4.0 * np.arange(LANES)])
    return Place(
        junctions_m=np.array([[0.0, 1.5 * 4.0]]),
        lanes=read_lanes(build_map(roads), np.array([-20.0, -20.0]), RADIUS_M),
        greens=Greens(green, stops_m, np.zeros(LANES)),
    )


def read(place, paths):
    ego = (-20.0, -20.0, 0.0, 0.0)
    seen = traffic(ego, *paths, steps=STEPS)
    return measure(seen, place, RADIUS_M, STEPS - 1 - NOW)


def pooled(place, many):
    counts = [read(place, paths) for paths in many]
    return {scale.name: sum(one[scale.name] for one in counts) for scale in SCALES}


@pytest.fixture(scope="module")
def apart(place):
    """Distance of each forecaster's rollouts to the logs, by what is read."""
    random = np.random.default_rng(0)
    logs = pooled(place, [simulate(random, 1.0) for _ in range(SCENES)])
    played = {
        name: [simulate(random, spread) for _ in range(SCENES * ROLLOUTS)]
        for name, spread in SPREAD.items()
    }
    now = [[np.repeat(path[NOW : NOW + 1], STEPS, axis=0) for path in paths]
           for paths in played["generator"]]  # fmt: skip
    counts = {name: pooled(place, many) for name, many in played.items()}
    counts["frozen"] = pooled(place, now)
    counts["emptied"] = pooled(place, [[]] * SCENES)
    return {
        name: {
            s.name: distance(logs[s.name][None], one[s.name][None], s)[0] for s in SCALES
        }
        for name, one in counts.items()
    }


@pytest.mark.parametrize("copy", ["collapsed", "dispersed", "frozen", "emptied"])
def test_the_generator_is_nearest_or_alone_measured(apart, copy):
    for scale in SCALES:
        own, other = apart["generator"][scale.name], apart[copy][scale.name]
        assert not np.isnan(own), scale.name
        assert np.isnan(other) or own < other, scale.name


def test_an_empty_street_has_lanes_without_traffic_and_nothing_else_to_read(apart):
    measured = {name for name, value in apart["emptied"].items() if not np.isnan(value)}

    # The ego stands: it has a speed, and no more.
    assert measured == {"speed", "acceleration", "lane_density", "lane_flow"}
