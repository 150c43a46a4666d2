"""Batches of rollouts that fit into the memory of a device.

A rollout has random streams of its own, so a batch and its two halves are the same
rollouts, but for rounding.
"""

import gc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from infgen.rollout.recording import Frame, RolloutStart
    from infgen.rollout.simulator import Simulator


class SimulationMemoryError(ValueError):
    """A single rollout does not fit into the memory of the device."""


@dataclass(slots=True)
class BatchSize:
    """Rollouts that are simulated at once.

    Attributes:
        rollouts: Their number; halved where that does not fit into the device's memory.
        halvings: How often it was halved.
    """

    rollouts: int
    halvings: int = 0


def simulate_in_memory(
    simulator: "Simulator",
    starts: "Sequence[RolloutStart]",
    size: BatchSize,
    tell: Callable[[float], None],
    *,
    mix_scenes: bool,
) -> "Iterator[tuple[list[RolloutStart], list[Frame]]]":
    """Simulate rollouts in batches.

    A batch that is too large for the memory of the device is simulated again as two halves;
    later ones are not larger.

    Args:
        simulator: Network and settings.
        starts: Where they begin.
        size: Rollouts of a batch; halved in place.
        tell: Called with the number of simulated rollouts at every token step of a batch.
        mix_scenes: Whether a batch may hold several scenes.

    Raises:
        SimulationMemoryError: if a single rollout is too large.
    """
    done = 0
    for _, group in groupby(starts, key=_batch_key(mix_scenes)):
        waiting = list(group)
        while waiting:
            batch = waiting[: size.rollouts]
            frames = _simulate(simulator, batch, done, tell)
            if frames is None:
                size.rollouts = _halved(simulator, batch)
                size.halvings += 1
                _free_memory()
                continue
            yield batch, frames
            done, waiting = done + len(batch), waiting[len(batch) :]


def _batch_key(mix_scenes: bool) -> "Callable[[RolloutStart], int]":
    """Return what neighbouring rollouts of one batch must have in common."""
    if mix_scenes:
        return lambda start: start.history.now  # A batch steps together.
    return lambda start: id(start.scene)


def _simulate(
    simulator: "Simulator",
    batch: "Sequence[RolloutStart]",
    done: int,
    tell: Callable[[float], None],
) -> "list[Frame] | None":
    """Simulate a batch; None if the memory of the device is too small for it."""
    import torch  # noqa: PLC0415

    from infgen.clock import CLOCK  # noqa: PLC0415
    from infgen.rollout.simulate import simulate  # noqa: PLC0415

    frames: list[Frame] = []
    duration_s = simulator.settings.duration_s
    try:
        for frame in simulate(simulator, batch):
            frames.append(frame)
            tell(done + len(batch) * len(frames) * CLOCK.token_s / duration_s)
    except torch.OutOfMemoryError:
        return None  # The error holds the tensors: it has to be gone before they are freed.
    return frames


def _halved(simulator: "Simulator", batch: "Sequence[RolloutStart]") -> int:
    if len(batch) == 1:
        start, settings = batch[0], simulator.settings
        raise SimulationMemoryError(
            f"scene {start.scene.scenario_id}: a single rollout does not fit into the free "
            f"memory of {simulator.device}, after batches of rollout.batch_rollouts="
            f"{settings.batch_rollouts} and smaller ones did not; set "
            "rollout.batch_rollouts=1 and fewer workers per device (--dask gpu:0), or "
            f"lower rollout.max_agents={settings.max_agents}"
        )
    return (len(batch) + 1) // 2


def _free_memory() -> None:
    """Give cached memory back to the device; a batch of another size is cut otherwise."""
    import torch  # noqa: PLC0415

    gc.collect()
    torch.cuda.empty_cache()
