"""The weights and the scenes that come with the package, ready to simulate."""

from collections.abc import Sequence
from pathlib import Path

from infgen.config import RolloutSettings
from infgen.pretrained import builtin_weights
from infgen.rollout.simulator import Simulator
from infgen.scene import Scene
from infgen.sources.towns import builtin_records
from infgen.sources.womd import iter_scenes
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages
from pipeline.stages.simulation import load_simulator
from pipeline.storage.weights import read_description

PROFILE = "pretrained"
"""The profile of the settings that go with the weights."""


def packaged_simulator() -> Simulator:
    """Load the weights of the package, with the settings of profile ``pretrained``."""
    folder: Path = builtin_weights()
    chosen = load_stages(DEFAULT_FILE, {}).choose(PROFILE)
    identity = str(read_description(folder)["weights"])
    settings = chosen.build("rollout", RolloutSettings)
    simulator, _ = load_simulator(folder, identity, settings)
    return simulator


def packaged_scenes(split: str = "training") -> Sequence[Scene]:
    """Read the built-in scenes of a split."""
    return [
        scene
        for path in builtin_records()
        if path.name.startswith(split)
        for scene in iter_scenes(path)
        if isinstance(scene, Scene)
    ]
