"""Simulation: scenes on disk to rollouts in memory, for the stages that roll out."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.config import RolloutSettings
from pipeline.stages.batch_memory import BatchSize, simulate_in_memory
from pipeline.stages.devices import decide_device, find_device, limit_memory, name_device

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

    Raises:
        DeviceError: if this process lacks the device that the settings name.
    """
    from infgen.rollout.precision import make_stepper  # noqa: PLC0415
    from infgen.rollout.simulator import Simulator  # noqa: PLC0415
    from pipeline.storage.weights import load_network, read_description  # noqa: PLC0415

    device = find_device(decide_device(settings), settings.device)
    limit_memory(device)
    network = load_network(weights).to(device).eval()
    simulator = Simulator(
        stepper=make_stepper(network, settings.precision),
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
    size: BatchSize | None = None,
    *,
    mix_scenes: bool | None = None,
) -> "Iterator[list[Rollout]]":
    """Simulate rollouts in batches, and collect them a few at a time.

    Args:
        simulator: Network and settings.
        starts: Where they begin.
        weights: Fingerprint of the weights.
        tell: Called with the number of simulated rollouts at every token step of a batch.
        size: Rollouts of a batch, for those who want to know how many it came to; else as
            in the settings.
        mix_scenes: Whether a batch may hold several scenes. By default it does on a CUDA
            device, which needs many rollouts to be busy, and not on a CPU, where rollouts
            then do not depend on which other scenes are simulated, not even in the last
            bits of sums.

    Raises:
        SimulationMemoryError: if a single rollout is too large for the device.
    """
    from infgen.rollout.recording import collect  # noqa: PLC0415

    size = size or BatchSize(simulator.settings.batch_rollouts)
    few = max(1, int(TOGETHER_S / simulator.settings.duration_s))
    if mix_scenes is None:
        mix_scenes = simulator.device.type != "cpu"
    batches = simulate_in_memory(simulator, starts, size, tell, mix_scenes=mix_scenes)
    for batch, frames in batches:
        for first in range(0, len(batch), few):
            places = range(len(batch))[first : first + few]
            yield collect(batch, frames, weights, places)


def about_run(simulator: "Simulator", size: BatchSize) -> dict[str, Any]:
    """Name the device of a unit, and the batches that did fit into its memory.

    For the part of a report that differs from run to run.
    """
    from infgen.rollout.precision import describe_precision  # noqa: PLC0415

    device = simulator.device
    precision = describe_precision(simulator.settings.precision, device.type)
    found: dict[str, Any] = {"device": name_device(device, precision)}
    if size.halvings:
        found |= {"batch_rollouts": size.rollouts, "out_of_memory": size.halvings}
    return found
