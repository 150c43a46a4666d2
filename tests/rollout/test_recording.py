import numpy as np

from infgen.clock import CLOCK
from infgen.rollout.population import (
    InsertedAgents,
    add_inserted,
    advance_agents,
    place_logged_agents,
)
from infgen.rollout.recording import NO_AGENT, Frame, collect
from infgen.rollout.rollout import NEVER
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import Presence


def play(begin, vocabulary, grid, seconds, speed=5, leave_at=None, add_at=None):
    """Everyone drives at one speed; row 1 may leave, someone may enter 30 m ahead."""
    population = place_logged_agents([begin], min_rows=4)[-1]
    now = begin.history.now
    for token in range(now + 1, now + 1 + CLOCK.tokens_in(seconds)):
        shape = population.agent_number.shape
        leave = np.zeros(shape, bool)
        leave[0, 1] = token == leave_at
        moved, path = advance_agents(population, np.full(shape, speed), leave, vocabulary)
        population = moved
        if token == add_at:
            population, _ = add_inserted(moved, car_ahead(grid))
        yield Frame(
            token=token,
            agent_number=moved.agent_number,
            path=path,
            shown=np.ones(path.shape[:3], bool),
            removed=moved.presence == Presence.REMOVED,
            inserted_number=np.where(
                population.agent_number != moved.agent_number,
                population.agent_number,
                np.int32(NO_AGENT),
            ),
            agent_type=population.agent_type,
            size_lwh_m=population.size_lwh_m,
        )


def car_ahead(grid):
    ahead = (grid.centre_m == [0, 30]).all(axis=1)
    return InsertedAgents(
        who=np.array([True]),
        position_m=grid.centre_m[ahead],
        turned_rad=grid.heading_centre_rad[60:61],
        agent_type=np.array([AgentType.VEHICLE], dtype=np.int8),
        size_lwh_m=np.array([[4.0, 2.0, 1.5]], dtype=np.float32),
    )


def test_the_history_is_the_log_and_the_future_goes_on_from_it(
    parked, start, metre_moves, grid
):
    begin = start(parked(1))

    (rollout,) = collect([begin], list(play(begin, metre_moves, grid, 2.0)), "weights")

    assert rollout.num_steps == 31
    assert rollout.valid.all()
    np.testing.assert_allclose(rollout.xyz_m[0, :11, 0], 0, atol=1e-6)
    np.testing.assert_allclose(rollout.xyz_m[0, 10:, 0], np.arange(21), atol=1e-4)
    np.testing.assert_array_equal(rollout.exit_step, [NEVER, NEVER])
    np.testing.assert_array_equal(rollout.entry_step, [0, 0])
    assert rollout.logged.all()


def test_an_agent_that_leaves_is_valid_to_the_end_of_its_last_half_second(
    parked, start, metre_moves, grid
):
    begin = start(parked(1))

    frames = list(play(begin, metre_moves, grid, 2.0, leave_at=3))
    (rollout,) = collect([begin], frames, "weights")

    assert rollout.exit_step[1] == 20
    np.testing.assert_array_equal(np.flatnonzero(~rollout.valid[1]), np.arange(21, 31))
    assert not rollout.xyz_m[1, 21:].any()


def test_a_newcomer_is_valid_from_the_step_after_its_entry(
    parked, start, metre_moves, grid
):
    begin = start(parked(1))

    frames = list(play(begin, metre_moves, grid, 2.0, add_at=3))
    (rollout,) = collect([begin], frames, "weights")

    np.testing.assert_array_equal(rollout.logged, [True, True, False])
    assert rollout.entry_step[2] == 20
    np.testing.assert_array_equal(np.flatnonzero(rollout.valid[2]), np.arange(21, 31))
    assert rollout.id[2] == begin.scene.tracks.id.max() + 1
    # The ego is at 10 m at step 20, the inserted agent 30 m ahead; a metre later, both
    # moved on.
    np.testing.assert_allclose(rollout.xyz_m[2, 21, 0], 41.0, atol=0.1)
    assert rollout.agent_type[2] == AgentType.VEHICLE
    np.testing.assert_allclose(rollout.size_lwh_m[2], [4.0, 2.0, 1.5])


def test_boxes_stand_on_the_road(parked, start, metre_moves, grid):
    begin = start(parked(1))

    frames = list(play(begin, metre_moves, grid, 2.0, add_at=3))
    (rollout,) = collect([begin], frames, "weights")

    # The road is flat at height 0: logged cars keep 0.8 m, the new one gets half of 1.5 m.
    np.testing.assert_allclose(rollout.xyz_m[:2, :, 2], 0.8, atol=1e-5)
    np.testing.assert_allclose(rollout.xyz_m[2, 21:, 2], 0.75, atol=1e-5)


def test_a_batch_gives_each_start_its_own_rollout(parked, start, metre_moves, grid):
    one, two = start(parked(1)), start(parked(1), index=4)
    frames = [
        Frame(
            token=frame.token,
            **{
                name: np.concatenate([getattr(frame, name)] * 2)
                for name in (
                    "agent_number",
                    "path",
                    "shown",
                    "removed",
                    "inserted_number",
                    "agent_type",
                    "size_lwh_m",
                )
            },
        )
        for frame in play(one, metre_moves, grid, 1.0)
    ]

    rollouts = collect([one, two], frames, "weights")

    assert [rollout.index for rollout in rollouts] == [0, 4]
    np.testing.assert_array_equal(rollouts[0].xyz_m, rollouts[1].xyz_m)
