import dataclasses

import numpy as np
import pytest
import torch

from infgen.config import ModelSettings, RolloutSettings, TokenSettings
from infgen.model.network import Network
from infgen.model.stepping import Stepper
from infgen.rollout.recording import collect
from infgen.rollout.rollout import NEVER
from infgen.rollout.simulate import simulate
from infgen.rollout.simulator import Simulator

SMALL = ModelSettings(
    width=16, heads=2, map_blocks=1, motion_blocks=1, scene_blocks=1, fourier_bands=4
)


@pytest.fixture
def network(metre_moves, bent_roads):
    torch.manual_seed(0)
    return Network(SMALL, metre_moves, bent_roads, TokenSettings()).eval()


@pytest.fixture
def play(network):
    """``play(starts, **settings)``: rollouts of an untrained network."""

    def run(starts, **settings):
        simulator = Simulator(
            stepper=Stepper(network),
            vocabulary=network.motion_vocabulary(),
            roads=network.map_vocabulary(),
            tokens=network.grid_settings,
            settings=RolloutSettings(**{"seconds": 4.0, "max_agents": 24, **settings}),
            device=torch.device("cpu"),
        )
        return collect(starts, list(simulate(simulator, starts)), "weights")

    return run


def force(network, *, add=None, leave=None):
    """Fix how likely it is that agents enter and leave."""
    for mlp, logit in ((network.cells.add, add), (network.motion.leave, leave)):
        if logit is not None:
            torch.nn.init.zeros_(mlp[-1].weight)
            torch.nn.init.constant_(mlp[-1].bias, logit)


def assert_equal(one, other, tolerance=0.0):
    for field in dataclasses.fields(one):
        left, right = getattr(one, field.name), getattr(other, field.name)
        if isinstance(left, np.ndarray) and left.dtype == np.float32:
            np.testing.assert_allclose(left, right, atol=tolerance, err_msg=field.name)
        else:
            assert np.array_equal(left, right), field.name


def test_the_same_seed_plays_the_same_rollout(crossing, start, play):
    scene = crossing()

    assert_equal(*(play([start(scene, 0)])[0] for _ in range(2)))


def test_another_index_plays_another_rollout(crossing, start, play):
    scene = crossing()

    one, other = play([start(scene, 0), start(scene, 1)])

    assert not np.array_equal(one.xyz_m[0], other.xyz_m[0])


def test_a_rollout_is_the_same_whatever_runs_beside_it(crossing, parked, start, play):
    scene = crossing()

    (alone,) = play([start(scene, 3)])
    beside = play([start(parked(4), 0), start(scene, 1), start(scene, 3)])[2]

    # Sums of other lengths round otherwise: predicted boxes may differ in the last bits.
    assert_equal(alone, beside, tolerance=1e-4)


def test_who_leaves_is_gone_and_the_ego_stays(crossing, start, play, network):
    force(network, leave=20.0)

    (rollout,) = play([start(crossing())], insert=False)

    assert rollout.valid[0].all()
    assert (rollout.exit_step[1:] == 15).all()
    assert not rollout.valid[1:, 16:].any()


def test_without_removal_everyone_stays(crossing, start, play, network):
    force(network, leave=20.0)

    (rollout,) = play([start(crossing())], insert=False, remove=False)

    assert (rollout.exit_step == NEVER).all()
    assert rollout.valid[:, 10:].all()


def test_newcomers_come_up_to_the_cap_and_inside_the_grid(crossing, start, play, network):
    force(network, add=20.0, leave=-20.0)

    (rollout,) = play([start(crossing())], max_insertions=3, seconds=1.0)

    new = ~rollout.logged
    assert new.sum() == 6
    np.testing.assert_array_equal(np.sort(rollout.entry_step[new]), [15] * 3 + [20] * 3)
    first = np.flatnonzero(new & (rollout.entry_step == 15))
    apart_m = rollout.xyz_m[first, 16, :2] - rollout.xyz_m[rollout.ego, 16, :2]
    assert (np.linalg.norm(apart_m, axis=1) < 75 + 25).all()


def test_nobody_enters_where_insertion_is_off(crossing, start, play, network):
    force(network, add=20.0)

    (rollout,) = play([start(crossing())], insert=False)

    assert rollout.logged.all()


def test_a_crowded_scene_keeps_to_its_rows(crossing, start, play, network):
    force(network, add=20.0, leave=-20.0)

    (rollout,) = play([start(crossing())], max_insertions=16, max_agents=10)

    assert rollout.valid[:, -1].sum() == 10


def test_a_crowded_scene_beside_it_gives_a_scene_no_more_room(
    parked, drive, start, play, network
):
    force(network, add=20.0, leave=-20.0)
    full, thin = start(parked(7)), start(drive())

    (alone,) = play([thin], max_insertions=16, max_agents=4)
    beside, crowded = play([thin, full], max_insertions=16, max_agents=4)

    assert crowded.valid[:, -1].sum() == 8
    assert beside.valid[:, -1].sum() == 4
    assert_equal(beside, alone, tolerance=1e-4)


def test_rows_are_used_again_and_lives_are_not(crossing, start, play, network):
    force(network, add=20.0, leave=20.0)  # everyone leaves at once, others come

    (rollout,) = play([start(crossing())], max_insertions=4, max_agents=9, seconds=5.0)

    assert len(rollout.id) == len(set(rollout.id.tolist()))
    assert len(rollout.id) > 20
    assert (rollout.valid.sum(axis=0) <= 9).all()
    runs = np.diff(np.pad(rollout.valid, ((0, 0), (1, 1))).astype(int), axis=1)
    assert ((runs == 1).sum(axis=1) <= 1).all(), "each life is one stretch of time"
