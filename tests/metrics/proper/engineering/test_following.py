import numpy as np
import pytest

from infgen.metrics.proper.engineering.encroachment import encroachments_s
from infgen.metrics.proper.engineering.headway import headways_s
from infgen.metrics.proper.engineering.stops import stops_s
from tests.metrics.proper.roads import at_speeds, path, vehicles

FAR_M = 20.0
"""Beside the ego, which stands at the origin."""


def test_headway_is_the_gap_between_bumpers_over_the_followers_speed():
    # Middles 24 m apart, cars 4 m long: 20 m at 10 m/s.
    found = headways_s(vehicles((-50.0, FAR_M, 0.0, 10.0), (-26.0, FAR_M, 0.0, 10.0)))

    np.testing.assert_allclose(found, 2.0, atol=1e-3)
    assert len(found) == 11  # Of 59 steps every fifth, the leader has none.


@pytest.mark.parametrize(
    "other",
    [
        (-26.0, FAR_M + 2.1, 0.0, 10.0),  # Beside: cars are 2 m wide.
        (-26.0, FAR_M, np.pi / 2, 0.0),  # Across.
        (-26.0, FAR_M, np.pi, 0.0),  # Coming towards it.
        (-74.0, FAR_M, 0.0, 0.0),  # Behind.
    ],
)
def test_who_is_not_ahead_in_the_same_way_is_not_followed(other):
    assert len(headways_s(vehicles((-50.0, FAR_M, 0.0, 4.0), other))) == 0


def test_headings_on_both_sides_of_a_half_turn_are_the_same_way():
    found = headways_s(
        vehicles((50.0, FAR_M, np.pi - 0.01, 10.0), (26.0, FAR_M, 0.01 - np.pi, 10.0))
    )

    assert len(found) == 11


def test_who_stands_follows_nobody():
    assert not len(headways_s(vehicles((-50.0, FAR_M, 0.0, 0.5), (-40.0, FAR_M, 0.0, 0.5))))


def crossing_cars(second_starts_m):
    """One car along +x in a row of places of 1.5 m, one along +y in a column of them."""
    steps = np.arange(82)
    return vehicles(
        path(30.0 - 20.05 + steps, 30.75, 0.0),
        path(30.75, 30.0 + second_starts_m + steps, np.pi / 2),
        size_lwh_m=[(4.5, 1.3, 1.5)] * 3,
        steps=82,
    )


def test_post_encroachment_time_is_from_leaving_a_place_to_arriving_there():
    # The rear of the first, 2.25 m behind its middle, is in the place (up to 1.5 m) until
    # step 23; the front of the second gets there (to 0 m) at step 48.
    np.testing.assert_allclose(encroachments_s(crossing_cars(-50.05)), [2.5])


def test_who_is_there_before_the_first_has_left_encroaches_at_once():
    np.testing.assert_allclose(encroachments_s(crossing_cars(-20.05)), [0.0])


def test_one_after_the_other_in_the_same_way_is_no_encroachment():
    found = vehicles((-50.0, FAR_M, 0.0, 10.0), (-26.0, FAR_M, 0.0, 10.0))

    assert len(encroachments_s(found)) == 0


def test_a_stop_lasts_from_standing_to_driving():
    x_m = at_speeds(-40.0, (10.0, 20), (0.0, 30), (10.0, 20))

    found = stops_s(vehicles(path(x_m, FAR_M), steps=71))

    # 31 places are the same; at the first and last of them a neighbour is elsewhere.
    np.testing.assert_allclose(found, [2.9])


@pytest.mark.parametrize(
    "speeds",
    [
        [(0.0, 40), (10.0, 30)],  # Began before.
        [(10.0, 30), (0.0, 40)],  # Does not end.
        [(0.0, 70)],  # Parked.
        [(10.0, 30), (0.0, 8), (10.0, 32)],  # Less than a second.
    ],
)
def test_stops_that_are_not_seen_whole_or_are_short_do_not_count(speeds):
    assert len(stops_s(vehicles(path(at_speeds(-40.0, *speeds), FAR_M), steps=71))) == 0
