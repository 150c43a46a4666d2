"""Conflicts of scenes that are drawn by hand: boxes are 4 by 2 m, token k goes k metres."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.geometry import to_world
from infgen.model.training.policy_gradient.avoided.braking import BRAKES_MPS2
from infgen.model.training.policy_gradient.avoided.conflicts import (
    are_in_conflict,
    conflicts_taken,
    find_conflicts,
)
from infgen.scene import AgentType

TOKENS, METRES = 7, 24


def still(x_m, y_m=0.0):
    """An agent that stands."""
    return [[x_m, y_m, 0.0]] * TOKENS


EGO_FAR_AWAY = still(-500)


def conflicts(drawn, metres, *ways, **changed):
    """Which of all motion tokens that the first agent might take first are in conflict."""
    rollouts = drawn(np.stack(ways, axis=1)[None])
    agents = replace(rollouts.batch.agents, **changed)
    rollouts = replace(rollouts, batch=replace(rollouts.batch, agents=agents))
    choices = np.zeros((metres.num_motion_tokens, 4), dtype=np.int64)
    choices[:, 1], choices[:, 3] = 1, np.arange(len(choices))
    return are_in_conflict(rollouts, choices, metres).tolist()


def first_conflict(drawn, metres, *ways, **changed):
    """The shortest motion token in conflict; all longer ones are, up to 30 m/s."""
    found = conflicts(drawn, metres, *ways, **changed)
    first = found.index(True) if any(found) else len(found)
    assert all(found[first:16])
    return first


def braked_m(token_m, time):
    """Way of a token, and of braking, until a quarter of a second times ``time + 1``."""
    speed_mps, way_m = 2.0 * token_m, token_m / 2 * min(time + 1, 2)
    for _ in range(500 * (time - 1)):
        slower_mps = max(0.0, speed_mps - BRAKES_MPS2 * 0.0005)
        way_m += 0.0005 * (speed_mps + slower_mps) / 2
        speed_mps = slower_mps
    return way_m


@pytest.mark.parametrize("gap_m", [5.5, 11.0, 20.0])
def test_a_token_is_in_conflict_if_braking_after_it_does_not_avert_it(drawn, metres, gap_m):
    found = conflicts(drawn, metres, still(0), still(gap_m))

    # Boxes overlap while their centres are less than 4 m apart.
    for token_m, in_conflict in enumerate(found):
        hits = any(abs(gap_m - braked_m(token_m, time)) < 4 for time in range(10))
        assert in_conflict == hits, token_m


def test_others_move_as_they_did_in_the_rollout(drawn, metres):
    leads = [[12 + 5 * at, 0, 0] for at in range(TOKENS)]
    meets = [[24 - 5 * at, 0, np.pi] for at in range(TOKENS)]

    stands, goes = (
        first_conflict(drawn, metres, still(0), way) for way in (still(12), leads)
    )

    assert stands < goes
    assert conflicts(drawn, metres, still(0), meets)[0]  # It has the other one ahead.


def test_who_is_run_into_from_behind_has_no_conflict(drawn, metres):
    behind = [[-12 + 3 * at, 0, 0] for at in range(TOKENS)]

    assert not any(conflicts(drawn, metres, still(0), behind))


def test_an_agent_that_was_not_there_yet_is_no_conflict(drawn, metres):
    ways = still(0), still(8)
    observed = torch.ones((1, TOKENS, 2), dtype=torch.bool)
    observed[:, 0, 1] = False

    assert any(conflicts(drawn, metres, *ways))
    assert not any(conflicts(drawn, metres, *ways, observed=observed))


def test_who_overlapped_from_the_beginning_has_no_conflict(drawn, metres):
    assert not any(conflicts(drawn, metres, still(0), still(2)))


def test_two_pedestrians_have_no_conflict(drawn, metres):
    walks = torch.full((1, 2), int(AgentType.PEDESTRIAN))

    assert not any(conflicts(drawn, metres, still(0), still(8), agent_type=walks))


def test_an_agent_that_brakes_keeps_to_its_own_way(drawn, metres):
    """It turns left on a circle of 12 m: what is straight ahead of it is not on its way."""
    angle = np.arange(TOKENS) * 5 / 12
    turns = np.stack([12 * np.sin(angle), 12 * (1 - np.cos(angle)), angle], axis=1)
    ahead, on_way = still(15), [[10.0, 6.5, 0.7]] * TOKENS

    # The token itself goes straight ahead, and only what follows turns.
    assert first_conflict(drawn, metres, still(0), ahead) == 4
    assert conflicts(drawn, metres, turns, ahead)[:8] == [False] * 8
    assert conflicts(drawn, metres, turns, on_way)[5]
    assert not any(conflicts(drawn, metres, still(0), on_way)[:8])


def test_conflicts_do_not_depend_on_where_the_scene_lies(drawn, metres):
    turns = [[4 * at, 0.3 * at**2, 0.15 * at] for at in range(TOKENS)]
    crosses = [[16, -15 + 5 * at, np.pi / 2] for at in range(TOKENS)]
    ways = [np.asarray(way, dtype=np.float64) for way in (turns, crosses)]
    frame = np.array([31.0, -12.0, 2.5])

    here, there = (
        conflicts(drawn, metres, *placed)
        for placed in (ways, [to_world(way, frame) for way in ways])
    )

    assert any(here)
    assert here == there


def test_who_comes_into_conflict_is_told_which_token_would_have_averted_it(drawn, metres):
    runs = [[5 * at, 0, 0] for at in range(TOKENS)]
    rollouts = drawn(np.stack([EGO_FAR_AWAY, runs, still(13)], axis=1)[None])

    found = find_conflicts(rollouts, metres)

    assert found.at.tolist() == [[0, 1, 1]]
    assert found.avoided[0].tolist() == conflicts(drawn, metres, runs, still(13))
    assert not found.avoided[0].all()
    assert found.avoided[0, 5]
    # It is too late at the second token step, but that token is in conflict as well.
    assert conflicts_taken(rollouts, metres).nonzero()[1].tolist() == [1, 2]
    assert found.taken == 2


def test_who_comes_into_conflict_again_is_told_again(drawn, metres):
    """It drives through one that stands, and later into another one."""
    runs = [[5 * at, 0, 0] for at in range(TOKENS)]
    rollouts = drawn(np.stack([EGO_FAR_AWAY, runs, still(8), still(28)], axis=1)[None])

    taken = conflicts_taken(rollouts, metres)[0, :, 1].nonzero()[0].tolist()
    found = find_conflicts(rollouts, metres)

    begins = [at for at in taken if at - 1 not in taken]
    assert len(begins) == 2
    assert found.at.tolist() == [[0, at, 1] for at in begins]


def test_the_ego_is_told_of_none(drawn, metres):
    runs = [[5 * at, 0, 0] for at in range(TOKENS)]
    rollouts = drawn(np.stack([runs, still(13)], axis=1)[None])

    found = find_conflicts(rollouts, metres)

    assert not len(found.at)
    assert found.taken == 2


def test_what_nothing_averts_is_told_as_taken_only(drawn, metres):
    """It stands, and the other one runs into it whatever it does."""
    meets = [[6 - 2 * at, 0, np.pi] for at in range(TOKENS)]
    short = replace(metres, path=metres.path[:, :1], real=metres.real[:, :1])
    rollouts = drawn(np.stack([EGO_FAR_AWAY, still(0), meets], axis=1)[None])
    rollouts.moved[..., 2] = False

    found = find_conflicts(rollouts, short)

    assert not len(found.at)
    assert found.taken > 0


def test_without_moves_nothing_is_taken(drawn, metres):
    rollouts = drawn(np.stack([still(0), still(9)], axis=1)[None])
    rollouts.moved.fill_(False)

    found = find_conflicts(rollouts, metres)

    assert found.avoided.shape == (0, METRES)
    assert found.taken == 0


def test_rollouts_are_taken_by_their_rows(drawn, metres):
    runs = [[5 * at, 0, 0] for at in range(TOKENS)]
    ways = [[EGO_FAR_AWAY, runs, still(x)] for x in (13, 13, 90)]
    rollouts = drawn(np.array([np.stack(each, axis=1) for each in ways]))

    found = find_conflicts(rollouts, metres)

    assert found.at[:, 0].tolist() == [0, 1]
    assert found.only(slice(1, 3)).at.tolist() == [[0, 1, 1]]
    assert not len(found.only(slice(2, 3)).at)
