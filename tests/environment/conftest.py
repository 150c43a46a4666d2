"""Environments with a small untrained network, in which nobody is inserted or removed."""

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="needs the extra `gym`")

from infgen.config import ModelSettings, RolloutSettings, TokenSettings
from infgen.environment.single import DriveEnv
from infgen.environment.vector import DriveVectorEnv
from infgen.model.network import Network
from infgen.model.stepping import Stepper
from infgen.rollout.simulator import Simulator

SMALL = ModelSettings(
    width=16, heads=2, map_blocks=1, motion_blocks=1, scene_blocks=1, fourier_bands=4
)
ALONE = {"insert": False, "remove": False, "max_agents": 8}


@pytest.fixture
def simulator(metre_moves, bent_roads):
    """``simulator(standing=False, **settings)``: whether all agents stand still."""

    def build(*, standing=False, **settings):
        torch.manual_seed(0)
        network = Network(SMALL, metre_moves, bent_roads, TokenSettings())
        stepper = Stepper(network)
        if standing:
            stand_still(stepper)
        return Simulator(
            stepper=stepper,
            vocabulary=metre_moves,
            roads=bent_roads,
            tokens=TokenSettings(),
            settings=RolloutSettings(**{**ALONE, "motion_top_k": 0, **settings}),
            device=torch.device("cpu"),
        )

    def stand_still(stepper):
        ask = stepper.motion_step
        moves = torch.arange(61) > 0  # Row 0 of the vocabulary goes 0 m.

        def stands(*arguments):
            said = ask(*arguments)
            said.packed.motion_logits.masked_fill_(moves, -torch.inf)
            return said

        stepper.motion_step = stands

    return build


@pytest.fixture
def drive_env(simulator):
    """``drive_env(*scenes, standing=False, rollout={}, **settings)``: one environment."""

    def build(*scenes, standing=False, rollout=None, **settings):
        playing = simulator(standing=standing, **(rollout or {}))
        return DriveEnv(playing, scenes, **settings)

    return build


@pytest.fixture
def drive_envs(simulator):
    """``drive_envs(count, *scenes, standing=False, rollout={}, **settings)``: a batch."""

    def build(count, *scenes, standing=False, rollout=None, **settings):
        playing = simulator(standing=standing, **(rollout or {}))
        return DriveVectorEnv(count, playing, scenes, **settings)

    return build


@pytest.fixture
def coast():
    """``coast(environments=None)``: the action that changes nothing, one or as many."""

    def action(environments=None):
        one = np.zeros(2, dtype=np.float32)
        return one if environments is None else np.tile(one, (environments, 1))

    return action
