from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.config import ModelSettings, RolloutSettings, TokenSettings
from infgen.model.network import Network
from infgen.model.stepping import Stepper
from infgen.rollout.recording import RolloutStart
from infgen.rollout.simulator import Simulator
from infgen.tokens.grid import make_grid
from infgen.tokens.tokenizer import tokenize_scene

SMALL = ModelSettings(
    width=16, heads=2, map_blocks=1, motion_blocks=1, scene_blocks=1, fourier_bands=4
)


@pytest.fixture
def simulator(metre_moves, bent_roads):
    """``player(model={}, **settings)``: an untrained network, ready to be played."""

    def build(model=None, **settings):
        torch.manual_seed(0)
        sizes = replace(SMALL, **(model or {}))
        network = Network(sizes, metre_moves, bent_roads, TokenSettings())
        return Simulator(
            stepper=Stepper(network),
            vocabulary=metre_moves,
            roads=bent_roads,
            tokens=TokenSettings(),
            settings=RolloutSettings(**{"seconds": 4.0, "max_agents": 24, **settings}),
            device=torch.device("cpu"),
        )

    return build


@pytest.fixture
def force():
    """``force(player, add=None, leave=None)``: fix log-odds of entering and leaving."""

    def fix(simulator, *, add=None, leave=None):
        network = simulator.stepper.network
        if add is not None:
            say(network.cells.add, add)
        if leave is not None:
            say(network.motion.leave, leave)

    def say(head, logit):
        torch.nn.init.zeros_(head[-1].weight)
        torch.nn.init.constant_(head[-1].bias, logit)

    return fix


@pytest.fixture
def grid():
    return make_grid(TokenSettings())


@pytest.fixture
def start(metre_moves, bent_roads):
    """``start(scene, index=0)``: what a rollout of a scene begins from."""

    def build(scene, index=0):
        history = tokenize_scene(
            scene, metre_moves, bent_roads, TokenSettings(), until=scene.now
        )
        return RolloutStart(scene=scene, history=history, index=index, seed=7)

    return build


@pytest.fixture
def nobody():
    """``nobody(rollouts, rows)``: choices of a half second in which all stand and stay."""

    def build(rollouts, rows):
        return np.zeros((rollouts, rows), dtype=np.int64), np.zeros((rollouts, rows), bool)

    return build
