"""Who is inserted and removed where, of vehicles whose ways are known."""

import importlib

import numpy as np
import pytest

from tests.benchmarks.test_contacts import BENCHMARKS

TOKENS = 6
DRIVES, STANDS = 0, 1


@pytest.fixture
def flow(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("vehicle_flow")


def tracks(flow, *vehicles):
    """Vehicles on a line with the ego, which stands at 0: first x, speed, steps there."""
    x_m = np.array([[0.0] * TOKENS, *(x + v * np.arange(TOKENS) for x, v, _ in vehicles)])
    there = np.array(
        [
            [True] * TOKENS,
            *([step in steps for step in range(TOKENS)] for *_, steps in vehicles),
        ]
    )
    is_vehicle = np.arange(len(there)) > 0
    heading_rad = np.where(x_m == x_m[:, :1], np.pi / 2, 0.0)
    heading_rad[:, :-1] = heading_rad[:, 1:]
    return flow.Tracks(np.stack([x_m, 0 * x_m], axis=-1), heading_rad, there, is_vehicle, 0)


def test_those_that_stay_are_neither_inserted_nor_removed(flow):
    found = flow.flow(tracks(flow, (30, 0, range(TOKENS)), (41, 2, range(TOKENS))))

    present, removed, inserted, steps = found
    np.testing.assert_array_equal(present[STANDS], [0, 5, 0, 0, 0, 0])
    np.testing.assert_array_equal(present[DRIVES], [0, 0, 5, 0, 0, 0])
    assert not removed.any()
    assert not inserted.any()
    assert (steps == 5).all()


def test_who_is_inserted_and_removed_is_told_by_what_it_does_and_where(flow):
    # One comes at 60 m and drives off from 62 m, one stands at 10 m for a single step.
    found = flow.flow(tracks(flow, (54, 2, {3, 4}), (10, 0, {2})))

    present, removed, inserted, _ = found
    np.testing.assert_array_equal(inserted[DRIVES], [0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(removed[DRIVES], [0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(present[DRIVES], [0, 0, 0, 2, 0, 0])
    np.testing.assert_array_equal(inserted[STANDS], [1, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(removed[STANDS], [1, 0, 0, 0, 0, 0])


def test_the_ego_and_who_is_there_at_the_end_only_are_not_counted(flow):
    found = flow.flow(tracks(flow, (30, 0, {TOKENS - 1})))

    assert not found[:3].any()


def test_rates_are_those_of_ten_seconds(flow):
    found = flow.flow(tracks(flow, (10, 0, {2})))

    (row,) = [row for row in flow.rows_of(found) if row["inserted_per_10s"]]
    assert row["vehicle"] == "stands"
    assert row["away_m"] == 0
    assert row["inserted_per_10s"] == pytest.approx(1 / 2.5 * 10)
    assert row["removed"] == 1
    assert row["present"] == pytest.approx(1 / 5)


def test_inserted_vehicles_are_told_by_where_they_face_and_whether_they_drive_on(flow):
    # One drives away at 60 m, one drives on behind the ego towards it, one stands across;
    # the last is gone after half a second.
    vehicles = (54, 2, {3, 4}), (-50, 2, {2, 3}), (10, 0, {2, 3, 4}), (12, 0, {3})
    inserted, drive, steps = flow.ways(tracks(flow, *vehicles))

    np.testing.assert_array_equal(inserted[0], [0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(inserted[1], [1, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(inserted[2], [0, 0, 1, 0, 0, 0])
    np.testing.assert_array_equal(drive[[0, 2]], inserted[[0, 2]])
    assert not drive[1].any()
    assert (steps == TOKENS - 1).all()


def test_rates_by_where_they_face_are_those_of_ten_seconds(flow):
    rows = flow.ways_rows(flow.ways(tracks(flow, (54, 2, {3, 4}))))

    (row,) = [row for row in rows if row["inserted_per_10s"]]
    assert (row["faces"], row["away_m"], row["drives"]) == ("away", 55.0, 1.0)
    assert row["inserted_per_10s"] == pytest.approx(1 / 2.5 * 10)
