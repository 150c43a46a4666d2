"""Network and scenes of an environment that is given none: those of the package."""

from collections.abc import Sequence
from functools import lru_cache
from importlib import import_module
from typing import cast

from infgen.rollout.simulator import Simulator
from infgen.scene import Scene

_FACADE = "infgen"
"""Knows how weights and records lie on disk, as its parts do not; imported when used."""


@lru_cache(maxsize=1)
def packaged_simulator() -> Simulator:
    """Return the weights that come with the package, loaded once per process.

    They are simulated with rules: what a learner is punished for, others are not to cause.
    """
    return cast(Simulator, import_module(_FACADE).load("towns", rules="safe").simulator)


@lru_cache(maxsize=1)
def packaged_scenes() -> Sequence[Scene]:
    """Return the training scenes that come with the package, read once per process."""
    return tuple(import_module(_FACADE).open_scenes("builtin", split="training"))
