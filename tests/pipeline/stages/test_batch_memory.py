"""Batches that do not fit into memory: halves of them are the same rollouts."""

import dataclasses

import numpy as np
import pytest
import torch

from infgen.config import RolloutSettings, TokenSettings
from infgen.model.network import Network
from infgen.model.stepping import Stepper
from infgen.rollout.simulator import Simulator
from pipeline.stages.batch_memory import BatchSize, SimulationMemoryError
from pipeline.stages.simulation import about_run, begin, simulate_all
from tests.pipeline.finished import TINY

FAILS_AT = 3
"""Token step, with those of the history, at which memory runs out: in mid-rollout."""


class LimitedStepper(Stepper):
    """A stepper for whose batches memory runs out, as PyTorch says it, beyond a size."""

    def __init__(self, network, most):
        super().__init__(network)
        self.most, self.begun = most, []

    def begin_on(self, maps, scene, rows):
        self.begun.append(len(scene))
        return super().begin_on(maps, scene, rows)

    def motion_step(self, memory, token_step, rows=None):
        if len(memory.scene) > self.most and memory.columns == FAILS_AT:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")
        return super().motion_step(memory, token_step, rows)


@pytest.fixture
def simulator(metre_moves, bent_roads):
    """``simulator(most, **settings)``: of an untrained network with so much memory."""

    def build(most=1000, **settings):
        torch.manual_seed(0)
        network = Network(TINY, metre_moves, bent_roads, TokenSettings()).eval()
        how = {"seconds": 2.0, "count": 4, "max_insertions": 1, "batch_rollouts": 8}
        return Simulator(
            stepper=LimitedStepper(network, most),
            vocabulary=metre_moves,
            roads=bent_roads,
            tokens=TokenSettings(),
            settings=RolloutSettings(**{**how, **settings}),
            device=torch.device("cpu"),
        )

    return build


@pytest.fixture
def starts(crossing, parked):
    """``starts(simulator)``: four rollouts each of two scenes."""
    scenes = [
        dataclasses.replace(scene, scenario_id=f"scene {at}")
        for at, scene in enumerate((crossing(), parked()))
    ]
    return lambda simulator: [one for scene in scenes for one in begin(simulator, scene)]


def simulated(simulator, starts, size=None, tell=lambda done: None, mix_scenes=True):
    """Rollouts in batches of several scenes, as on the devices whose memory is small."""
    begun = starts(simulator)
    groups = simulate_all(simulator, begun, "weights", tell, size, mix_scenes=mix_scenes)
    return [rollout for group in groups for rollout in group]


def assert_same(ours, theirs, tolerance):
    assert len(ours) == len(theirs)
    for one, other in zip(ours, theirs, strict=True):
        for field in dataclasses.fields(one):
            left, right = getattr(one, field.name), getattr(other, field.name)
            if isinstance(left, np.ndarray) and left.dtype.kind == "f":
                np.testing.assert_allclose(left, right, atol=tolerance)
            else:
                assert np.array_equal(left, right), field.name


def test_halves_are_the_rollouts_of_an_undisturbed_run(simulator, starts):
    size, limited = BatchSize(8), simulator(most=3)

    ours = simulated(limited, starts, size)

    assert limited.stepper.begun == [8, 4, 2, 2, 2, 2]
    assert (size.rollouts, size.halvings) == (2, 2)
    assert_same(ours, simulated(simulator(), starts), tolerance=1e-4)
    assert_same(ours, simulated(simulator(batch_rollouts=2), starts), tolerance=0.0)


def test_a_batch_of_an_odd_number_is_halved_too(simulator, starts):
    limited = simulator(most=4, batch_rollouts=7)

    assert len(simulated(limited, starts)) == 8
    assert limited.stepper.begun == [7, 4, 4]


def test_on_a_cpu_a_batch_holds_one_scene_unless_it_is_told_to_mix(simulator, starts):
    apart, mixed = simulator(batch_rollouts=3), simulator(batch_rollouts=3)

    simulated(apart, starts, mix_scenes=None)
    simulated(mixed, starts)

    assert apart.stepper.begun == [3, 1, 3, 1]  # Four rollouts each of two scenes.
    assert mixed.stepper.begun == [3, 3, 2]


def test_the_run_record_says_which_batches_did_fit(simulator, starts):
    limited, size = simulator(most=3), BatchSize(8)
    undisturbed = about_run(limited, size)

    simulated(limited, starts, size)

    assert about_run(limited, size) == {
        **undisturbed,
        "batch_rollouts": 2,
        "out_of_memory": 2,
    }
    assert undisturbed.keys() == {"device"}


def test_progress_ends_with_all_rollouts(simulator, starts):
    told = []

    simulated(simulator(most=4), starts, tell=told.append)

    assert max(told) == told[-1] == 8.0


def test_a_single_rollout_that_does_not_fit_says_what_to_set(simulator, starts):
    with pytest.raises(
        SimulationMemoryError,
        match=r"scene 0: a single rollout .* rollout.batch_rollouts=8 .* set "
        r"rollout.batch_rollouts=1 .* rollout.max_agents=128",
    ):
        simulated(simulator(most=0), starts)


def test_other_errors_are_not_taken_for_a_lack_of_memory(simulator, starts):
    limited = simulator(most=3)
    limited.stepper.motion_step = lambda *_: torch.ones(2) @ torch.ones(3)

    with pytest.raises(RuntimeError, match="size"):
        simulated(limited, starts)
