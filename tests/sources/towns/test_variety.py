"""Towns of all varieties: what differs, and that traffic stays plausible."""

from collections import Counter

import numpy as np
import pytest

from infgen.clock import CLOCK
from infgen.scene import AgentType
from infgen.sources.towns.numbering import draw_scenes
from infgen.sources.towns.road_users import LaneChanging, draw_motorist
from infgen.sources.towns.streets.boxes import meet
from infgen.sources.towns.town import make_town, stream
from infgen.sources.towns.traffic.demand import draw_level
from infgen.sources.towns.variety import BASIC, BROAD, VARIETIES, CarFollowing
from infgen.sources.womd_write import encode_scenario
from tests.sources.towns.conftest import needs_sumo

STEPS = 300


def test_basic_comes_first_and_names_are_their_own():
    assert list(VARIETIES) == ["basic", "broad", "recovery", "steady"]
    assert all(VARIETIES[name].name == name for name in VARIETIES)


@pytest.mark.parametrize("variety", VARIETIES.values(), ids=VARIETIES)
def test_shares_sum_to_one(variety):
    shares = (
        variety.streets.patterns,
        variety.streets.arterial_lanes,
        variety.streets.collector_lanes,
        variety.drivers.car_following,
    )
    for each in shares:
        assert sum(each.values()) == pytest.approx(1.0)


def test_drivers_of_broad_towns_follow_and_change_lanes_in_their_own_ways():
    basic, broad = (
        [draw_motorist(np.random.default_rng(at), each.drivers) for at in range(300)]
        for each in (BASIC, BROAD)
    )

    assert {each.car_following for each in basic} == {CarFollowing.IDM}
    assert {each.lane_changing for each in basic} == {LaneChanging()}
    counts = Counter(each.car_following for each in broad)
    for model, share in BROAD.drivers.car_following.items():
        assert counts[model] / 300 == pytest.approx(share, abs=0.08)
    assert len({each.lane_changing for each in broad}) == 300
    # All else about them is drawn from ranges as wide, or wider.
    headway_s = np.array([[each.headway_s for each in some] for some in (basic, broad)])
    assert headway_s[1].std() > headway_s[0].std()


def test_demand_of_broad_towns_spreads_more_widely():
    basic, broad = (
        [draw_level(np.random.default_rng(at), each.demand) for at in range(300)]
        for each in (BASIC, BROAD)
    )

    spread = [
        np.std(np.log([each.cars_per_km for each in some])) for some in (basic, broad)
    ]
    assert spread[1] > 1.5 * spread[0]
    assert {each.parking for each in basic} == {0.0}
    assert max(each.parking for each in broad) <= BROAD.demand.parking


@pytest.fixture(scope="module")
def town():
    """A broad town with one-way streets, parking vehicles and all models."""
    return make_town(stream("plaus", 6), STEPS, 1.0, BROAD)


@needs_sumo
@pytest.mark.slow
def test_traffic_of_a_broad_town_is_plausible(town):
    bodies, vehicle = town.bodies, town.kind == AgentType.VEHICLE
    both = (bodies.present[:, 5:] & bodies.present[:, :-5])[vehicle]
    velocity_mps = bodies.velocity_mps[vehicle]
    change_mps = np.linalg.norm(velocity_mps[:, 5:] - velocity_mps[:, :-5], axis=-1)
    yaw_rate = np.abs(np.diff(bodies.pose[vehicle, :, 2], axis=1)) / CLOCK.step_s
    there = (bodies.present[:, 1:] & bodies.present[:, :-1])[vehicle]

    assert np.quantile(change_mps[both] / 0.5, 0.999) < 8.0
    assert np.quantile(yaw_rate[there], 0.999) < 0.8
    assert yaw_rate[there].max() < 1.6


@needs_sumo
@pytest.mark.slow
def test_hardly_anyone_of_a_broad_town_overlaps(town):
    bodies = town.bodies
    speed_mps = np.linalg.norm(bodies.velocity_mps, axis=-1)
    overlaps, moving = [], []
    for step in range(0, STEPS, 10):
        rows = np.flatnonzero(bodies.present[:, step] & (town.kind == AgentType.VEHICLE))
        size_m = 0.97 * town.size_lwh_m[rows]
        boxes = np.column_stack([bodies.pose[rows, step], size_m])
        met = meet(boxes, boxes) & ~np.eye(len(rows), dtype=bool)
        overlaps += met.any(axis=1).tolist()
        moves = speed_mps[rows, step] > 1.0
        moving += met[moves][:, moves].any(axis=1).tolist()
    assert np.mean(overlaps) < 0.015
    assert np.mean(moving) < 0.003
    # Nor does anyone drive through what is parked for good.
    standing = town.surroundings.parked
    for step in (0, STEPS // 2, STEPS - 1):
        rows = np.flatnonzero(bodies.present[:, step])
        boxes = np.column_stack([bodies.pose[rows, step], town.size_lwh_m[rows]])
        near = np.abs(boxes[:, None, :2] - standing[:, :2]).max(axis=2) < 12.0
        at, other = np.nonzero(near)
        pairs = [
            meet(boxes[a, None], standing[b, None]) for a, b in zip(at, other, strict=True)
        ]
        assert not np.any(pairs)


@needs_sumo
@pytest.mark.slow
def test_some_park_and_some_pull_out_in_a_broad_town(town):
    speed_mps = np.linalg.norm(town.bodies.velocity_mps, axis=-1)
    aside = _aside_of_lanes(town)
    stands = (speed_mps < 0.05) & town.bodies.present & aside
    drives = (speed_mps > 2.0) & town.bodies.present
    both = (town.kind == AgentType.VEHICLE) & stands.any(axis=1) & drives.any(axis=1)

    assert both.sum() >= 2


def _aside_of_lanes(town):
    """Who is more than two metres from the middle of every lane."""
    points_m = np.concatenate([lane.border(0.0) for lane in town.network.lanes.values()])
    points_m = np.concatenate([points_m, *[way.xy_m for way in town.network.connectors]])
    found = np.zeros(town.bodies.present.shape, bool)
    for step in range(0, STEPS, 20):
        xy_m = town.bodies.pose[:, step, :2]
        apart_m = np.linalg.norm(xy_m[:, None] - points_m, axis=-1).min(axis=1)
        found[:, step] = apart_m > 2.2
    return found


@needs_sumo
@pytest.mark.slow
def test_broad_towns_have_streets_of_one_way(town):
    backs = {"f": "b", "b": "f"}
    streets = [name for name in town.network.edges if name[-1] in backs]
    alone = [name for name in streets if name[:-1] + backs[name[-1]] not in streets]

    assert alone
    assert len(alone) < len(streets) / 3


@needs_sumo
@pytest.mark.slow
def test_scenes_of_a_variety_depend_on_their_number_alone():
    both = list(draw_scenes(5, "training", 40, 3, 2, BROAD))
    (alone,) = draw_scenes(5, "training", 40, 4, 1, BROAD)
    (basic,) = draw_scenes(5, "training", 40, 4, 1)

    assert encode_scenario(both[1]) == encode_scenario(alone)
    assert basic.scenario_id != alone.scenario_id
