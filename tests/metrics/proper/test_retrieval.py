import numpy as np
import pytest

from infgen.metrics.proper.context import CONTEXT
from infgen.metrics.proper.quantities import SCORES
from infgen.metrics.proper.retrieval import (
    NEIGHBOURS,
    LogCourse,
    retrieve,
    sample_logs,
    score_retrieved,
)
from tests.metrics.proper.test_counts import course


def log(name, value=0.0, vehicles=(1, 1)) -> LogCourse:
    context = np.full(len(CONTEXT), value, dtype=np.float32)
    return LogCourse(str(name), context, course(*vehicles, windows=len(vehicles)))


def test_a_sample_is_the_same_in_any_order_and_uniform():
    logs = [log(at) for at in range(400)]

    one = sample_logs(logs, most=100)

    assert one == sample_logs(reversed(logs), most=100)
    assert 35 <= sum(int(kept.scenario_id) < 200 for kept in one) <= 65
    assert sample_logs(logs[:5], most=100) != []


def test_the_nearest_situations_are_retrieved_but_never_the_scene_itself():
    logs = [log(at, value=at) for at in range(20)]

    found = retrieve("10", logs[10].context, logs)

    assert len(found) == NEIGHBOURS
    assert {int(one.scenario_id) for one in found} == {6, 7, 8, 9, 11, 12, 13, 14}
    assert {int(one.scenario_id) for one in found[:2]} == {9, 11}


def test_each_group_of_numbers_weighs_the_same_and_constants_nothing():
    names = [name for name, _ in CONTEXT]
    ego, vehicles = names.index("ego_speed_mps"), names.index("vehicles")

    def situated(name, **values):
        one = log(name)
        for key, value in values.items():
            one.context[{"ego": ego, "vehicles": vehicles}[key]] = value
        return one

    # The ego's group has two numbers, that of density five.
    logs = [situated("ego", ego=2.0), situated("vehicles", vehicles=2.0), situated("same")]
    found = retrieve("own", log("own").context, logs)

    assert [one.scenario_id for one in found] == ["same", "vehicles", "ego"]


def test_without_logs_nothing_is_retrieved_or_scored():
    assert retrieve("own", log("own").context, []) == []
    with pytest.raises(ValueError, match="no logs to score rollouts against"):
        score_retrieved([course(1, 1)], [])


def test_rollouts_are_held_against_every_log_and_the_last_known_window_after_its_end():
    members = [course(0, 0, 0, windows=3), course(2, 2, 2, windows=3)]
    logs = [log("one", vehicles=(1, 1)), log("two", vehicles=(3, 5))]

    table = score_retrieved(members, logs)

    # 0 and 2 against 1: 0; against 3: 2 - 1; against 5: 4 - 1, and again.
    vehicles = table[:, SCORES.index("vehicles")]
    np.testing.assert_allclose(vehicles, [(0 + 1) / 2, (0 + 3) / 2, (0 + 3) / 2])
