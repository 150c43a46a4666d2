import numpy as np
import pytest

from infgen.exports.rows import rows_of
from tests.exports.replays import replay, with_newcomer


def test_there_is_a_row_for_every_rollout_agent_and_step_and_no_other(crossing):
    scene = crossing()
    rollouts = [with_newcomer(replay(scene, at, 1.0 * at), 40) for at in range(2)]

    rows = rows_of(rollouts, scene)

    keys = list(zip(rows["rollout"], rows["agent"], rows["step"], strict=True))
    assert keys == sorted(set(keys))
    assert len(keys) == sum(int(one.valid.sum()) for one in rollouts)
    assert len({len(column) for column in rows.values()}) == 1


def test_a_row_tells_where_and_what_an_agent_is(crossing):
    scene = crossing()
    rows = rows_of([with_newcomer(replay(scene, 3, 2.0), 40)], scene)
    (at,) = np.flatnonzero((rows["agent"] == 104) & (rows["step"] == 41))
    found = {name: column[at].item() for name, column in rows.items()}

    assert found["rollout"] == 3
    assert found["time_s"] == pytest.approx(3.1)
    assert (found["x_m"], found["y_m"]) == pytest.approx((1001, -1993), abs=1e-3)
    assert (found["length_m"], found["width_m"], found["height_m"]) == (4, 2, 1.5)
    assert found["velocity_x_mps"] == pytest.approx(10, abs=1e-2)
    assert not any(found[name] for name in ("is_ego", "is_logged", "is_history"))


def test_the_history_and_the_ego_are_marked(crossing):
    scene = crossing()
    rows = rows_of([replay(scene)], scene)

    assert set(rows["agent"][rows["is_ego"]].tolist()) == {100}
    assert rows["step"][rows["is_history"]].max() == scene.now
    assert rows["step"][~rows["is_history"]].min() == scene.now + 1
    assert rows["is_logged"].all()
