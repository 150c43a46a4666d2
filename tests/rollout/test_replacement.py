"""Rollouts that take the place of others in a running batch are as if they ran alone."""

from dataclasses import replace

import numpy as np
import pytest

from infgen.rollout.begun_step import logged_step
from infgen.rollout.recording import NO_AGENT
from infgen.rollout.session import Session
from tests.rollout.single_rules import only

LIVELY = {
    **{"rules": "safe", "max_motion_samples": 3, "max_stall_s": 1.0},
    **{"max_insertions": 2, "max_agents": 24, "motion_top_k": 0},
}


def ego_path(session, ahead_m=1.0):
    """Poses at the five steps of a token step, straight on at 10 m/s."""
    steps = ahead_m * np.arange(1, 6, dtype=np.float32)[:, None]
    heading_rad = session.ego_pose[:, None, 2]
    path = np.repeat(session.ego_pose[:, None], 5, axis=1)
    path[..., 0] += steps[:, 0] * np.cos(heading_rad)
    path[..., 1] += steps[:, 0] * np.sin(heading_rad)
    return path


def driven_step(session):
    return session.end_step(session.begin_step(driven=True), ego_path(session))


def replaced_at(session, place, begin, logged):
    """Replace a rollout in the next token step, its ego as logged."""
    begun = session.replace(session.begin_step(driven=True), [place], [begin])
    path = ego_path(session)
    path[place] = logged.path[0, 0]
    return session.end_step(begun, path)


@pytest.fixture
def renamed(crossing, start):
    """``renamed(name, **scene)``: a start of a crossing that has another id."""

    def build(name, **more):
        return start(replace(crossing(**more), scenario_id=name))

    return build


@pytest.mark.parametrize("relations", ["features", "rotary"])
@pytest.mark.parametrize("after", [0, 3])
def test_a_replaced_rollout_goes_as_it_would_alone(
    crossing, start, simulator, renamed, after, relations
):
    playing = simulator({"relations": relations}, **LIVELY)
    other = renamed("other", speed_mps=8.0)
    session = Session(playing, [start(crossing(), at) for at in range(3)])
    alone = Session(playing, other)
    for _ in range(after):
        driven_step(session)

    frame = replaced_at(session, 1, other, logged_step([other], 24))

    # The history of the one is over now: from here on both go on alike.
    assert (frame.inserted_number[1] == NO_AGENT).all()
    np.testing.assert_array_equal(session.own_token, [after + 2, 1, after + 2])
    np.testing.assert_allclose(
        session.population.pose[1], alone.population.pose[0], atol=1e-5
    )
    for _ in range(5):
        many, one = driven_step(session), driven_step(alone)
        np.testing.assert_array_equal(many.agent_number[1], one.agent_number[0])
        np.testing.assert_array_equal(many.inserted_number[1], one.inserted_number[0])
        np.testing.assert_allclose(many.path[1], one.path[0], atol=1e-4)
    inserted = session.population.agent_number[1] >= other.history.num_agents
    assert inserted.any(), "nothing is shown if nobody was ever inserted"


def test_rollouts_do_not_notice_that_another_is_replaced(
    crossing, start, simulator, renamed
):
    playing, other = simulator(**LIVELY), renamed("other", speed_mps=8.0)
    begin = [start(crossing(), at) for at in range(3)]
    replaced, kept = Session(playing, begin), Session(playing, begin)
    driven_step(replaced), driven_step(kept)

    replaced_at(replaced, 1, other, logged_step([other], 24))
    driven_step(kept)

    for _ in range(3):
        one, another = driven_step(replaced), driven_step(kept)
        np.testing.assert_array_equal(
            one.agent_number[[0, 2]], another.agent_number[[0, 2]]
        )
        np.testing.assert_allclose(one.path[[0, 2]], another.path[[0, 2]], atol=1e-4)


def test_until_its_history_ends_a_replaced_rollout_goes_as_logged(
    crossing, start, simulator, renamed
):
    playing, other = simulator(**LIVELY), renamed("other", speed_mps=6.0)
    session = Session(playing, [start(crossing(), at) for at in range(2)])
    driven_step(session)

    begun = session.replace(session.begin_step(driven=True), [0], [other])

    # Row 0 is the ego, at 6 m/s from (-40, 0): steps 6 to 10 of its log.
    np.testing.assert_allclose(
        begun.path[0, 0, :, 0], [-36.4, -35.8, -35.2, -34.6, -34.0], atol=1e-4
    )
    assert begun.is_history.tolist() == [True, False]


def test_a_scene_with_more_agents_than_there_are_rows_gets_more_rows(
    crossing, parked, start, simulator
):
    rules = only(max_stall_s=1.0, max_motion_samples=2)
    playing = simulator(insert=False, max_agents=4, **rules)
    session = Session(playing, [start(crossing(), at) for at in range(2)])
    assert session.num_rows == 4
    crowded = start(parked(8))
    alone = Session(playing, crowded)

    replaced_at(session, 0, crowded, logged_step([crowded], 9))

    assert session.num_rows == 9
    for _ in range(4):
        many, one = driven_step(session), driven_step(alone)
        np.testing.assert_allclose(many.path[0], one.path[0], atol=1e-4)


def test_a_history_of_one_token_step_is_too_short(crossing, start, simulator):
    session = Session(simulator(), start(crossing()))

    with pytest.raises(ValueError, match="history of one token step"):
        session.replace(session.begin_step(driven=True), [0], [start(crossing(now=5))])


def test_a_step_in_two_halves_is_a_step(crossing, start, simulator):
    """Without rejection nobody looks at where the ego goes in the same token step."""
    playing, begin = simulator(motion_top_k=0, max_insertions=2), start(crossing())
    halves, whole = Session(playing, begin), Session(playing, begin)
    for _ in range(4):
        path = ego_path(halves)
        one, another = driven_step(halves), whole.step(path)

        np.testing.assert_array_equal(one.path, another.path)
        np.testing.assert_array_equal(one.inserted_number, another.inserted_number)
