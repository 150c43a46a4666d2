from dataclasses import replace

import numpy as np
import pytest

from infgen.metrics.proper.counts import (
    score_climatology,
    score_ensemble,
    score_persistence,
)
from infgen.metrics.proper.course import Course
from infgen.metrics.proper.quantities import (
    QUANTITIES,
    SCORES,
    pad_courses,
    read_course,
    read_courses,
)


def course(*vehicles, now=2, entries=0, windows=2) -> Course:
    """So many vehicles in the inner ring in each window; entries in the inner ring."""
    present = np.zeros((windows, 3, 3), dtype=np.float32)
    present[:, 0, 0] = vehicles
    held = np.zeros((3, 3), dtype=np.float32)
    held[0, 0] = now
    events = np.zeros((windows, 5), dtype=np.float32)
    events[:, 0] = entries
    return Course(held, present, events, 0 * events)


def column(table, name):
    return table[:, SCORES.index(name)].tolist()


def test_counts_of_a_course_are_read_by_type_and_of_all_rings():
    one = course(3, 5, entries=2)
    one.present[1, 2, 1] = 4  # Cyclists in the second ring.

    read = read_course(one)

    names = list(QUANTITIES)
    np.testing.assert_array_equal(read.single[1, names.index("vehicles")], 5)
    np.testing.assert_array_equal(read.single[1, names.index("cyclists")], 4)
    np.testing.assert_array_equal(read.single[:, names.index("entries")], 2)
    np.testing.assert_array_equal(read.nearer, np.full((2, 5), 2))
    assert read.cells[1].sum() == 9


def test_an_ensemble_is_scored_window_by_window():
    members = read_courses([course(0, 1), course(2, 3)])

    table = score_ensemble(members, read_course(course(1, 0)))

    assert column(table, "vehicles") == [0, 1]  # 1 - 1 and 2 - 1.
    assert column(table, "energy") == [0, 1]
    assert column(table, "entries") == [0, 0]


def test_as_many_as_now_is_off_by_what_changes():
    table = score_persistence(course(2, 5, now=2, entries=1))

    assert column(table, "vehicles") == [0, 3]
    assert column(table, "energy") == [0, 3]
    assert column(table, "entries") == [1, 1]
    assert column(table, "entry_distance") == [1, 1]  # Missing at every distance.


def test_entries_too_far_out_miss_at_the_distances_between():
    inner, outer = course(0, 0, entries=1), course(0, 0, entries=0)
    outer.entries[:, 4] = 1
    members = read_courses([outer, outer])

    table = score_ensemble(members, read_course(inner))

    assert column(table, "entries") == [0, 0]
    assert column(table, "entry_distance") == [0.8, 0.8]  # At four of five distances.


def test_climatology_is_the_distribution_of_the_other_logs_as_far_as_they_go():
    short = course(0, windows=1)
    others = pad_courses([course(1, 0), course(3, 4), short])

    table = score_climatology(course(2, 2), others)

    # Of 1, 3, 0 against 2: 4 / 3 less 12 / 12; then 0 and 4 against 2: 2 less 2.
    np.testing.assert_allclose(column(table, "vehicles"), [1 / 3, 0])
    np.testing.assert_allclose(column(table, "energy"), [1 / 3, 0])


def test_a_log_that_does_not_know_its_last_exits_leaves_the_others_theirs():
    short = course(0, windows=1)
    short.exits[:] = np.nan

    table = score_climatology(
        course(2, 2), pad_courses([course(1, 0), course(3, 4), short])
    )

    assert column(table, "exits") == [0, 0]
    alone = score_climatology(course(2, 2), pad_courses([course(1, 1), short]))
    assert np.isnan(alone[:, SCORES.index("exits")]).all()


def test_beyond_all_other_logs_climatology_is_not_measured():
    others = pad_courses([course(1, windows=1), course(3, windows=1)])

    table = score_climatology(course(2, 2), others)

    assert np.isnan(table[1]).all()
    assert not np.isnan(table[0]).any()


@pytest.mark.parametrize("read", [read_courses, pad_courses])
def test_without_courses_there_is_nothing_to_read(read):
    with pytest.raises(ValueError, match="course"):
        read([])


def test_equal_counts_are_equal_whatever_they_are_summed_from():
    shares = course(0, 0)
    shares.present[:, 0] = [0.7, 0.2, 0.1]
    whole = replace(course(1, 1))

    np.testing.assert_array_equal(read_course(shares).single, read_course(whole).single)
