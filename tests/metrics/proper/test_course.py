import numpy as np
import pytest

from infgen.metrics.proper.course import follow_course
from infgen.metrics.windows import Windows
from tests.metrics.proper.roads import path, traffic

STEPS = 82  # Eight seconds after step 1.
FOUR = Windows(num_tokens=16, length=4, stride=4)
RADIUS_M = 75.0
EGO = (0.0, 0.0, 0.0, 0.0)


def follow(*paths, windows=FOUR, **more):
    return follow_course(traffic(EGO, *paths, steps=STEPS, **more), RADIUS_M, windows)


def test_agents_are_counted_by_type_and_ring_and_the_ego_is_not():
    # Rings of 25 m: a car in the first, a pedestrian in the third, one out of sight.
    still = [(10.0, 0.0, 0.0, 0.0), (0.0, 60.0, 0.0, 0.0), (0.0, 80.0, 0.0, 0.0)]

    course = follow(*still, agent_type=np.array([0, 0, 1, 2], dtype=np.int8))

    expected = np.zeros((3, 3))
    expected[0, 0] = expected[1, 2] = 1
    np.testing.assert_array_equal(course.now, expected)
    np.testing.assert_array_equal(course.present, [expected] * 4)
    assert course.entries.sum() == 0
    assert np.nansum(course.exits) == 0


def test_whoever_drives_in_enters_the_outer_ring_and_exits_in_the_last_window_it_is_seen():
    # At 2 m a step from 115 m to 35 m, and back.
    coming = path(35 + 2.0 * np.abs(np.arange(STEPS) - 40))

    course = follow(coming)

    # Nearer than 75 m at steps 21 to 59; steps 2 to 21 are the first window.
    assert np.argwhere(course.entries == 1).tolist() == [[0, 4]]
    assert np.argwhere(course.exits == 1).tolist() == [[2, 4]]


def test_windows_share_their_steps_between_them():
    # Seen at the first ten of the twenty steps of the third window only.
    valid = np.ones((2, STEPS), bool)
    valid[1] = False
    valid[1, 42:52] = True

    course = follow((10.0, 0.0, 0.0, 0.0), valid=valid)

    np.testing.assert_allclose(course.present[:, 0, 0], [0, 0, 0.5, 0])
    np.testing.assert_array_equal(np.argwhere(course.entries), [[2, 0]])
    np.testing.assert_array_equal(np.argwhere(course.exits == 1), [[2, 0]])


def test_exits_are_not_known_where_the_last_second_is_part_of_the_window():
    course = follow((10.0, 0.0, 0.0, 0.0))

    assert np.isnan(course.exits[3]).all()
    assert not np.isnan(course.exits[:3]).any()


def test_who_is_there_now_for_the_last_time_exits_at_once():
    valid = np.ones((2, STEPS), bool)
    valid[1, 2:] = False

    course = follow((10.0, 0.0, 0.0, 0.0), valid=valid)

    assert course.exits[0, 0] == 1
    assert course.now[0, 0] == 1


@pytest.mark.parametrize("windows", [1, 3])
def test_what_lies_beyond_the_last_window_does_not_count(windows):
    valid = np.ones((2, STEPS), bool)
    valid[1, : 2 + 20 * windows] = False
    few = Windows(num_tokens=4 * windows, length=4, stride=4)

    course = follow((10.0, 0.0, 0.0, 0.0), valid=valid, windows=few)

    assert course.windows == windows
    assert course.present.sum() == course.entries.sum() == 0
