"""Who runs into whom: cars of 4 by 2 m on a straight road, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from infgen.rollout.population import Population
from infgen.rollout.rules.collision import find_collisions, repeat
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import Presence

CAR, WALKER = AgentType.VEHICLE, AgentType.PEDESTRIAN


def everyone(*poses, agent_type=CAR) -> Population:
    """A population of one rollout at some poses."""
    one = (1, len(poses))
    size_lwh_m = np.empty((*one, 3), dtype=np.float32)
    size_lwh_m[:] = 4.0, 2.0, 1.5
    return Population(
        agent_number=np.zeros(one, dtype=np.int32),
        agent_type=np.full(one, agent_type, dtype=np.int8),
        size_lwh_m=size_lwh_m,
        pose=np.array([poses], dtype=np.float32),
        motion_token=np.zeros(one, dtype=np.int16),
        presence=np.full(one, Presence.PRESENT, dtype=np.int8),
        observed=np.ones(one, dtype=bool),
        num_agents_so_far=np.zeros(1, dtype=np.int32),
    )


def ways(population, *metres):
    """Straight on, each so far: in the middle and at the end."""
    pose = population.pose[0]
    ahead = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=-1)
    way = np.repeat(pose[:, None], 2, axis=1)
    way[..., :2] += np.outer(metres, [0.6, 1.0])[..., None] * ahead[:, None]
    return way[None].astype(np.float32)


def hits(population, *metres):
    there = population.presence != Presence.ABSENT
    return find_collisions(population, there, ways(population, *metres))[0].tolist()


@pytest.mark.parametrize(
    ("metres", "found"),
    [
        ((5.9, 0.0), [False, False]),  # Boxes end 0.1 m apart,
        ((6.1, 0.0), [True, False]),  # 0.1 m in each other: the one behind runs in.
        ((6.1, 1.0), [False, False]),  # The one ahead drives on.
        ((0.0, 0.0), [False, False]),
    ],
)
def test_who_is_behind_runs_into_who_is_ahead(metres, found):
    assert hits(everyone((0, 0, 0), (10, 0, 0)), *metres) == found


def test_who_meets_runs_into_each_other():
    oncoming = everyone((0, 0, 0), (12, 0, np.pi))

    assert hits(oncoming, 5.0, 5.0) == [True, True]


def test_who_has_crossed_another_by_the_end_met_it_on_the_way():
    """Across a car that stands, from 6 m south to 6 m north of it."""
    crossing = everyone((0, 0, 0), (1, -6, np.pi / 2))

    assert hits(crossing, 0.0, 12.0)[1]
    assert not any(hits(crossing, 0.0, 1.0))


def test_who_overlaps_already_is_not_kept_from_moving():
    assert hits(everyone((0, 0, 0), (3, 0, 0)), 0.5, 0.0) == [False, False]


def test_who_is_gone_is_in_nobodys_way():
    population = everyone((0, 0, 0), (10, 0, 0))
    there = np.array([[True, False]])

    assert not find_collisions(population, there, ways(population, 8.0, 0.0)).any()


def test_walkers_pass_through_each_other_but_not_through_cars():
    walkers = everyone((0, 0, 0), (10, 0, 0), agent_type=WALKER)
    mixed = walkers.agent_type.copy()
    mixed[0, 1] = CAR

    assert hits(walkers, 8.0, 0.0) == [False, False]
    assert hits(replace(walkers, agent_type=mixed), 8.0, 0.0) == [True, False]


def test_who_is_alone_hits_nobody():
    assert hits(everyone((0, 0, 0)), 9.0) == [False]


def test_a_move_that_is_made_again_leads_as_far_again(metre_moves):
    """Two token steps of five metres each, northwards, looked at twice each."""
    population = everyone((1, 2, np.pi / 2))

    found = repeat(population, np.array([[5]]), metre_moves, 2)

    np.testing.assert_allclose(found[0, 0, :, 0], 1, atol=1e-5)
    np.testing.assert_allclose(found[0, 0, :, 1], [5, 7, 10, 12], atol=1e-5)
