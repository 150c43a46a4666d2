"""Scenes of the package, and rollouts of them by the weights of the package."""

import pytest

import infgen

QUIET = 3
"""A scene of the validation split with few agents."""


@pytest.fixture(scope="session")
def builtin():
    return infgen.open_scenes("builtin", split="validation")


@pytest.fixture(scope="session")
def scene(builtin):
    return builtin[QUIET]


@pytest.fixture(scope="session")
def rollouts(scene):
    return infgen.load("towns").rollout(scene, seconds=8, count=2, seed=5)
