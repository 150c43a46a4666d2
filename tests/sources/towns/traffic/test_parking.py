"""Parking and pulling out: by hand, and as SUMO plays it at a crossing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from infgen.clock import CLOCK
from infgen.sources.towns.road_users import draw_motorist
from infgen.sources.towns.streets.street_types import Rank, draw_street
from infgen.sources.towns.traffic.demand import Trip, write_routes
from infgen.sources.towns.traffic.motion import follow
from infgen.sources.towns.traffic.parking import (
    LEAD_M,
    STRAIGHT_M,
    ParkingSpace,
    ParkingStop,
    find_spaces,
    with_parking,
)
from infgen.sources.towns.traffic.simulation import Played, play
from infgen.sources.towns.traffic.stops import with_stops
from infgen.sources.towns.traffic.trips import find_ways
from infgen.sources.towns.variety import BASIC, CarFollowing
from tests.sources.towns.conftest import needs_sumo

NET = Path(__file__).parents[1] / "crossing.net.xml"
DRIVER = replace(draw_motorist(np.random.default_rng(0)), size_lwh_m=(4.6, 1.9, 1.6))
ASIDE_M = 2.6
SPACE = ParkingSpace(
    edge="e1b",
    lane=2,
    along_m=40.0,
    front_m=np.array([40.0, -ASIDE_M]),
    heading_rad=0.0,
    wide_m=2.2,
)


@pytest.fixture
def spaces(crossing):
    """Spaces along the two arms of the crossing that have parked cars."""
    street = replace(draw_street(Rank.LOCAL, np.random.default_rng(0)), parking_m=2.2)
    bare = replace(street, parking_m=0.0)
    streets = {name: street if name[1] in "13" else bare for name in crossing.edges}
    return find_spaces(crossing, streets)


def drive_and_park():
    """East along y = 0 at 5 m/s to x = 40 m by step 100, where SUMO parks it at y = -8."""
    x_m = np.minimum(-10.0 + 0.5 * np.arange(150.0), 40.0)
    parked = np.arange(150) >= 101
    front_m = np.column_stack([x_m, np.where(parked, -8.0, 0.0)])
    speed_mps = np.where(np.arange(150) <= 100, 5.0, 0.0)
    zeros = np.zeros((1, 150))
    return Played(front_m[None], zeros, speed_mps[None], np.ones((1, 150), bool))


def test_a_vehicle_that_parks_ends_in_the_middle_of_the_strip():
    parked = with_parking(drive_and_park(), [(ParkingStop(SPACE, None, 1e5),)])

    y_m, x_m = parked.front_m[0, :, 1], parked.front_m[0, :, 0]
    np.testing.assert_allclose(y_m[101:], -ASIDE_M)
    assert (np.diff(y_m) <= 1e-9).all()
    np.testing.assert_array_equal(x_m, drive_and_park().front_m[0, :, 0])
    # It leaves the middle of its lane 17 m before, and is over 5 m before it stops.
    assert y_m[x_m < 40.0 - LEAD_M - STRAIGHT_M - 0.5].min() == 0.0
    np.testing.assert_allclose(y_m[x_m > 40.0 - STRAIGHT_M + 0.5], -ASIDE_M, atol=0.01)


def test_pulling_out_is_parking_backwards():
    driven = drive_and_park()
    mirrored = np.array([80.0, 0.0]) - driven.front_m[:, ::-1] * [1.0, -1.0]
    out = replace(driven, front_m=mirrored, speed_mps=driven.speed_mps[:, ::-1])

    y_m = with_parking(out, [(ParkingStop(SPACE, 5.0),)]).front_m[0, :, 1]

    np.testing.assert_allclose(y_m[:49], -ASIDE_M)
    assert y_m[-1] == 0.0
    assert (np.diff(y_m) >= -1e-9).all()


def test_a_vehicle_that_never_reaches_its_space_is_left_alone():
    driven = drive_and_park()
    elsewhere = replace(SPACE, front_m=np.array([400.0, -ASIDE_M]))

    left = with_parking(driven, [(ParkingStop(elsewhere, None, 9.0),)])

    np.testing.assert_array_equal(left.front_m, driven.front_m)


def test_spaces_lie_in_the_strip_far_from_each_other_and_from_junctions(spaces):
    assert {space.edge[:2] for space in spaces} == {"e1", "e3"}
    for space in spaces:
        # The strip is 2.2 m wide beside a lane of 3 m that ends at the middle of the road.
        assert abs(space.front_m[0]) == pytest.approx(4.1, abs=0.01)
        assert space.lane == 2
        assert 25.0 < space.along_m < 65.0
        assert DRIVER.size_lwh_m[1] < space.wide_m


def test_as_many_pull_out_as_park_and_no_space_is_used_twice(crossing, spaces):
    ways = find_ways(crossing, cycling=False)
    trips = [
        Trip(DRIVER, 0.1 * at, ["e0b", "e3f"] if at % 2 else ["e2b", "e1f"], anywhere=False)
        for at in range(40)
    ]

    found = with_stops(
        trips, 0.5, spaces, ways, 60.0, BASIC.drivers, np.random.default_rng(0)
    )

    used = [id(stop.space) for trip in found for stop in trip.stops]
    assert len(set(used)) == len(used) > 1
    assert any(trip.pulls_out for trip in found)
    departures = [trip.depart_s for trip in found]
    assert departures == sorted(departures)
    for trip in found:
        assert all(stop.space.edge in trip.route for stop in trip.stops)


def test_who_drives_without_stops_is_drawn_as_before(crossing, spaces):
    trips = [Trip(DRIVER, 0.0, ["e0b", "e3f"], anywhere=False)]
    ways = find_ways(crossing, cycling=False)
    rng = np.random.default_rng(0)

    assert with_stops(trips, 0.0, spaces, ways, 60.0, BASIC.drivers, rng) == trips


@needs_sumo
@pytest.mark.slow
@pytest.mark.parametrize("model", CarFollowing)
def test_in_sumo_one_pulls_out_and_another_parks(tmp_path, spaces, model):
    space = next(space for space in spaces if space.edge == "e1b")
    there = next(space for space in spaces if space.edge == "e3f")
    driver = replace(DRIVER, car_following=model)
    trips = [
        Trip(driver, 0.0, ["e1b", "e3f"], False, (ParkingStop(space, 6.0),)),
        Trip(driver, 0.1, ["e0b", "e3f"], False, (ParkingStop(there, None, 1e5),)),
    ]
    write_routes(trips, tmp_path / "town.rou.xml")
    played = play(NET, tmp_path / "town.rou.xml", 2, 9, 0.5, 900, 1)

    bodies = follow(
        with_parking(played, [trip.stops for trip in trips]),
        np.array([trip.person.size_lwh_m[0] for trip in trips]),
        np.zeros(2, bool),
    )

    # The crossing's arms run along y; lanes are 1.5 m, strips 4.1 m from the middle.
    aside_m = np.abs(bodies.pose[:, :, 0])
    assert aside_m[0, 10] == pytest.approx(4.1, abs=0.1)
    moving = np.linalg.norm(bodies.velocity_mps, axis=-1) > 3.0
    assert aside_m[0, moving[0] & bodies.present[0]].min() < 1.8
    assert aside_m[1, -1] == pytest.approx(4.1, abs=0.15)
    turned_rad = np.angle(np.exp(1j * (bodies.pose[1, -1, 2] - there.heading_rad)))
    assert abs(turned_rad) < np.deg2rad(4)
    assert_smooth(bodies)


def assert_smooth(bodies):
    for row in range(2):
        there = bodies.present[row]
        yaw_rate = np.diff(bodies.pose[row, there, 2]) / CLOCK.step_s
        assert np.abs(yaw_rate).max() < 1.2
        change_mps = (
            bodies.velocity_mps[row, there][5:] - bodies.velocity_mps[row, there][:-5]
        )
        assert (np.linalg.norm(change_mps, axis=1) / 0.5).max() < 8.0
