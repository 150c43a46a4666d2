"""What stands beside the road keeps off it, and off each other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from infgen.geometry import box_corners
from infgen.sources.towns.streets.boxes import clear_way, meet
from infgen.sources.towns.streets.plots import Plot, Site, SurroundingsDensity, build_on
from infgen.sources.towns.streets.street_types import Rank, Street
from infgen.sources.towns.streets.surroundings import surround

STREET_M = np.column_stack([np.linspace(-200, 200, 134), np.zeros(134)])
STREETS = {
    f"e{link}{way}": Street(Rank.LOCAL, 1, 3.0, 25.0, 0.0, 0.0, 2.2, 2.0, True, 0.9)
    for link in (1, 3)
    for way in "fb"
}
ALL_LOTS = SurroundingsDensity(
    lots=1.0, houses=0.0, blocks=0.0, taken=1.0, people_per_km=0.0
)
ALL_HOUSES = SurroundingsDensity(
    lots=0.0, houses=1.0, blocks=0.0, taken=1.0, people_per_km=0.0
)
ALL_BLOCKS = SurroundingsDensity(
    lots=0.0, houses=0.0, blocks=1.0, taken=1.0, people_per_km=0.0
)


def box(x_m, y_m, heading_rad=0.0, length_m=4.0, width_m=2.0):
    return np.array([[x_m, y_m, heading_rad, length_m, width_m, 1.5]])


def plot(wide_m=20.0):
    """North of a street along the x axis: looking away from it."""
    return Plot(np.array([0.0, 3.0, np.pi / 2]), wide_m, 2.0)


@pytest.mark.parametrize(
    ("other", "meets"),
    [(box(3.9, 0), True), (box(4.1, 0), False), (box(0, 2.5, 1.6), True)],
)
def test_boxes_meet_when_they_overlap(other, meets):
    assert meet(box(0, 0), other).tolist() == [[meets]]


def test_of_two_boxes_that_meet_the_first_is_built():
    site, built = Site(STREET_M), []
    boxes = np.concatenate([box(0, 20), box(1, 20), box(9, 20)])

    assert site.put(boxes, built) == 2
    assert [each[0] for each in built] == [0, 9]
    assert site.put(box(10, 20), built) == 0


def test_nothing_is_built_on_a_road():
    site = Site(STREET_M)

    assert site.put(box(0, 1.5), []) == 0
    assert site.put(box(0, 2.5), []) == 1


@pytest.mark.parametrize("plenty", [ALL_LOTS, ALL_HOUSES, ALL_BLOCKS])
def test_plots_are_built_beyond_the_pavement(plenty):
    site = Site(STREET_M)
    driveway = build_on(plot(), plenty, site, np.random.default_rng(0))
    things = np.array([*site.walls, *site.parked])

    assert len(things)
    assert box_corners(things[:, :3], things[:, 3:5])[..., 1].min() > 3.0 + 2.0
    assert (driveway is None) == (plenty is ALL_BLOCKS)
    if driveway is not None:
        assert driveway[:, 1].min() == pytest.approx(3.0)


def test_a_lot_that_is_full_has_a_car_in_every_stall():
    site = Site(STREET_M)
    build_on(plot(wide_m=22.1), ALL_LOTS, site, np.random.default_rng(0))

    assert len(site.parked) % 8 == 0  # 22.1 m are eight stalls of 2.75 m a row.


def test_cars_in_the_way_of_traffic_are_taken_away():
    parked = np.concatenate([box(0, 0), box(50, 0), box(100, 0)])
    x_m = np.arange(30.0, 70.0)
    passing = np.column_stack([x_m, 0 * x_m + 1.5, 0 * x_m])

    kept = clear_way(parked, passing, np.full((len(x_m), 2), [4.5, 1.9]))

    assert kept[:, 0].tolist() == [0, 100]


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_who_stands_in_the_way_is_found_as_if_everyone_were_asked(seed):
    rng = np.random.default_rng(seed)
    parked, passing = (
        np.column_stack([rng.uniform(-45, 45, (n, 2)), rng.uniform(-4, 4, n)])
        for n in (40, 60)
    )
    size_lwh_m = rng.uniform(1, 6, (60, 3))
    boxes = np.column_stack([parked, rng.uniform(1, 6, (40, 3))])
    others = np.column_stack([passing, size_lwh_m])

    kept = clear_way(boxes, passing, size_lwh_m[:, :2])

    np.testing.assert_array_equal(kept, boxes[~meet(boxes, others).any(axis=1)])


def test_around_a_crossing_nothing_overlaps_and_nobody_parks_near_the_junction(crossing):
    found = surround(crossing, STREETS, ALL_HOUSES, np.random.default_rng(0))
    things = np.concatenate([found.walls, found.parked])

    assert len(found.parked) > 40
    assert not np.triu(meet(things, things), 1).any()
    assert np.linalg.norm(found.parked[:, :2], axis=1).min() > 18


def test_people_stand_on_pavements(crossing):
    busy = SurroundingsDensity(
        lots=0.0, houses=0.0, blocks=0.0, taken=0.0, people_per_km=200.0
    )

    people = surround(crossing, STREETS, busy, np.random.default_rng(0)).people

    # The pavement is 2 m wide and begins 5.2 m from the middle of the street.
    across_m = np.abs(people[:, 0])
    assert len(people) > 20
    assert np.all((across_m > 4.8) & (across_m < 7.6))
