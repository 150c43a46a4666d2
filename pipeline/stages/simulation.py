"""Simulation: scenes on disk to rollouts in memory, for the stages that roll out."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import groupby, islice
from pathlib import Path
from typing import TYPE_CHECKING

from infgen.clock import CLOCK
from infgen.config import RolloutSettings

if TYPE_CHECKING:
    from infgen.rollout.recording import RolloutStart
    from infgen.rollout.rollout import Rollout
    from infgen.rollout.simulator import Simulator
    from infgen.scene import Scene

TOGETHER_S = 1000.0
"""Seconds of rollouts that are made whole at once: 33 of 30 s, or one of ten minutes."""


@lru_cache(maxsize=2)
def load_simulator(
    weights: Path, identity: str, settings: RolloutSettings
) -> "tuple[Simulator, str]":
    """Load weights once per process: it may outlive what was at a path when it began.

    Returns:
        The simulator, and the fingerprint of the weights.
    """
    import torch  # noqa: PLC0415

    from infgen.model.stepping import Stepper  # noqa: PLC0415
    from infgen.rollout.simulator import Simulator  # noqa: PLC0415
    from pipeline.storage.weights import load_network, read_description  # noqa: PLC0415

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network = load_network(weights).to(device).eval()
    simulator = Simulator(
        stepper=Stepper(network),
        vocabulary=network.motion_vocabulary(),
        roads=network.map_vocabulary(),
        tokens=network.grid_settings,
        settings=settings,
        device=device,
    )
    return simulator, str(read_description(weights)["weights"])


def read_some(folder: Path, rows: Sequence[int]) -> "Iterator[Scene]":
    """Read some scenes of an ingested file; rows are ascending."""
    from pipeline.storage.scenes import read_scenes  # noqa: PLC0415

    wanted = set(rows)
    scenes = islice(read_scenes(folder), max(rows, default=-1) + 1)
    return (scene for row, scene in enumerate(scenes) if row in wanted)


def begin(simulator: "Simulator", scene: "Scene") -> "list[RolloutStart]":
    """Tokenize a scene's history, for all of its rollouts.

    Raises:
        ValueError: if it cannot be simulated, with the reason.
    """
    from infgen.rollout.recording import RolloutStart  # noqa: PLC0415
    from infgen.tokens.tokenizer import read_logged_signals, tokenize_scene  # noqa: PLC0415

    tokens, settings = simulator.tokens, simulator.settings
    if settings.simulates_all_agents:
        tokens = replace(tokens, max_ego_distance_m=1e9)  # All agents.
    history = tokenize_scene(
        scene, simulator.vocabulary, simulator.roads, tokens, until=scene.now
    )
    lights = read_logged_signals(scene) if settings.signals == "log" else None
    return [
        RolloutStart(scene, history, at, settings.seed, lights)
        for at in range(settings.count)
    ]


def simulate_all(
    simulator: "Simulator",
    starts: "Sequence[RolloutStart]",
    weights: str,
    tell: Callable[[float], None],
) -> "Iterator[list[Rollout]]":
    """Simulate rollouts in batches, and collect them a few at a time.

    Args:
        simulator: Network and settings.
        starts: Where they begin.
        weights: Fingerprint of the weights.
        tell: Called with the number of simulated rollouts at every token step of a batch.
    """
    from infgen.rollout.recording import Frame, collect  # noqa: PLC0415
    from infgen.rollout.simulate import simulate  # noqa: PLC0415

    duration_s, done = simulator.settings.duration_s, 0
    few = max(1, int(TOGETHER_S / duration_s))
    for batch in _batches(starts, simulator.settings.batch_rollouts):
        frames: list[Frame] = []
        for frame in simulate(simulator, batch):
            frames.append(frame)
            tell(done + len(batch) * len(frames) * CLOCK.token_s / duration_s)
        done += len(batch)
        for first in range(0, len(batch), few):
            places = range(len(batch))[first : first + few]
            yield collect(batch, frames, weights, places)


def _batches(starts: "Sequence[RolloutStart]", size: int) -> "Iterator[list[RolloutStart]]":
    """Cut into batches whose histories are of one length."""
    for _, group in groupby(starts, key=lambda start: start.history.now):
        alike = list(group)
        yield from (alike[at : at + size] for at in range(0, len(alike), size))
