import numpy as np
import pytest

from infgen.config import TokenSettings
from infgen.rollout.trace import Start
from infgen.tokens.grid import make_grid
from infgen.tokens.tokenizer import tokenize_scene


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
        return Start(scene=scene, history=history, index=index, seed=7)

    return build


@pytest.fixture
def nobody():
    """``nobody(rollouts, rows)``: choices of a half second in which all stand and stay."""

    def build(rollouts, rows):
        return np.zeros((rollouts, rows), dtype=np.int64), np.zeros((rollouts, rows), bool)

    return build
