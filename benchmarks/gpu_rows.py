"""Rows of ``benchmarks/gpu.py``: each measures one thing on a device."""

import time
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
import rollout
import torch
import training
from gpu_peaks import find_peak
from made_vocabularies import made_vocabularies
from measuring import (
    SIZES,
    await_device,
    is_cpu,
    peak_mib,
    read_scene,
    read_small_scene,
)
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from infgen.clock import CLOCK
from infgen.config import RolloutSettings, TokenSettings, TrainSettings
from infgen.model.batching.batch import Limits, MapTokens, collate, to_device
from infgen.model.neighbours import MapFeatures
from infgen.model.network import Network
from infgen.model.relations import Rows
from infgen.model.sampling import choose
from infgen.model.step_memory import StepMemory
from infgen.model.stepping import Stepper
from infgen.model.token_step import MotionStep, TokenStep
from infgen.pretrained import builtin_weights
from infgen.rollout.precision import Precision, describe_precision, make_stepper
from infgen.rollout.recording import Frame, RolloutStart
from infgen.rollout.session import Session
from infgen.rollout.simulator import Simulator
from infgen.scene import Scene
from infgen.tokens.tokenizer import tokenize_scene
from pipeline.stages.train.setup import repeatable
from pipeline.storage.weights import load_network

ROLLOUT_S = 30.0
FORCED_STEPS, FORCED_ROLLOUTS, FORCED_TOP_K = 8, 4, 5
"""What choices are compared on: token steps, rollouts, and motion tokens to choose from."""
LOGITS_LIMIT, CHOICES_LIMIT = 1e-3, 0.99
"""In float32: largest difference of logits, and smallest share of equal choices."""
DEAREST, FEW, SMALL_SIDE = 10, 2, 512
GRAPH_STEPS, SAME_PLACE_M = 3, 1e-3
"""Token steps in which rollouts with and without graphs are compared, and how nearly."""
Kind = Literal["logits", "choices", "training", "rollouts", "graphs", "kernels"]


@dataclass(frozen=True, slots=True)
class Row:
    """What is measured.

    Attributes:
        kind: What.
        size: Of the network, as in ``measuring.SIZES``, or ``builtin`` for the weights of
            the package.
        batch: Scenes or rollouts at once.
        precision: Of matrix products.
    """

    kind: Kind
    size: str
    batch: int
    precision: Precision

    @property
    def name(self) -> str:
        """All of it in words."""
        return f"{self.kind} {self.size} {self.batch} {self.precision}"


@dataclass(frozen=True, slots=True)
class Place:
    """Where and how long.

    Attributes:
        device: As PyTorch names it.
        threads: Of the processor.
        row_s: Steps are repeated for so long.
        small: Whether this is about the code and not about speed: a small scene.
    """

    device: str
    threads: int
    row_s: float
    small: bool

    @property
    def name(self) -> str:
        """Model of the device, or how many threads of a CPU."""
        if torch.device(self.device).type == "cuda":
            return torch.cuda.get_device_name(self.device)
        if not is_cpu(self.device):
            return self.device
        return f"CPU, {self.threads} thread" + ("s" if self.threads > 1 else "")

    def scene(self) -> Scene:
        """The scene of all rows."""
        return read_small_scene() if self.small else read_scene()


def measure(row: Row, place: Place) -> dict[str, Any]:
    """Measure a row, in this process."""
    torch.set_num_threads(place.threads)
    if torch.device(place.device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(place.device)
    return MEASURES[row.kind](row, place)


def measure_logits(row: Row, place: Place) -> dict[str, Any]:
    """Compare all outputs of one pass over a scene with those of a CPU."""
    grid, (motion, roads) = TokenSettings(), made_vocabularies()
    tokens = tokenize_scene(place.scene(), motion, roads, grid)
    model = SIZES[row.size]
    batch = collate([tokens] * row.batch, Limits.of(model, TrainSettings(), grid), 0)
    torch.manual_seed(0)
    network = Network(model, motion, roads, grid).eval()
    with torch.no_grad():
        expected = _floats(network(batch))
        device = torch.device(place.device)
        found = _floats(network.to(device)(to_device(batch, device)))
    gap = max(
        float((one.cpu() - other).abs().max())
        for one, other in zip(found, expected, strict=True)
        if other.numel()
    )
    return {"largest_gap": gap, "holds": gap <= LOGITS_LIMIT}


def _floats(record: Any) -> list[Tensor]:
    """All numbers of a record that are not whole, in order."""
    if isinstance(record, Tensor):
        return [record.float()] if record.is_floating_point() else []
    if not is_dataclass(record):
        return []
    return [x for each in fields(record) for x in _floats(getattr(record, each.name))]


class _Recorder(Stepper):
    """A stepper that keeps what it was shown and what it said."""

    def encode_maps(self, roads: MapTokens) -> Tensor:
        self.roads = roads
        return super().encode_maps(roads)

    def begin_on(self, maps: MapFeatures, scene: Tensor, rows: int) -> StepMemory:
        self.scene, self.rows = scene, rows
        self.steps: list[tuple[TokenStep, Rows | None, MotionStep]] = []
        return super().begin_on(maps, scene, rows)

    def motion_step(
        self, memory: StepMemory, token_step: TokenStep, rows: Rows | None = None
    ) -> MotionStep:
        said = super().motion_step(memory, token_step, rows)
        self.steps.append((token_step, rows, said))
        return said


@cache
def _recorded(threads: int, rollouts: int) -> _Recorder:
    """Rollouts of the package's weights on the CPU: what they were shown and said."""
    network, scene = load_network(builtin_weights()).eval(), read_small_scene()
    books, grid = (
        (network.motion_vocabulary(), network.map_vocabulary()),
        network.grid_settings,
    )
    history = tokenize_scene(scene, *books, grid, until=scene.now)
    settings, recorder = RolloutSettings(seconds=ROLLOUT_S), _Recorder(network)
    simulator = Simulator(recorder, *books, grid, settings, torch.device("cpu"))
    starts = [RolloutStart(scene, history, at, settings.seed) for at in range(rollouts)]
    session = Session(simulator, starts)
    for _ in range(FORCED_STEPS):
        session.step()
    return recorder


def measure_choices(row: Row, place: Place) -> dict[str, Any]:
    """Show the same token steps to the network here and on a CPU; compare what is sampled.

    The weights are those of the package: choices of untrained ones are close to ties.
    """
    recorder, device = _recorded(place.threads, row.batch), torch.device(place.device)
    network = load_network(builtin_weights()).to(device).eval()
    stepper = make_stepper(network, row.precision)
    roads, scene = to_device(recorder.roads, device), recorder.scene.to(device)
    memory = stepper.begin(roads, scene, recorder.rows)
    same, gap = [], 0.0
    for token_step, shown, said in recorder.steps:
        here = None if shown is None else to_device(shown, device)
        step = stepper.motion_step(memory, to_device(token_step, device), here)
        one, other = said.packed.motion_logits, step.packed.motion_logits.cpu()
        uniform = torch.linspace(0.005, 0.995, len(one), dtype=torch.float64)
        gap = max(gap, float((one - other).abs().max()))
        same.append(
            choose(one, uniform, FORCED_TOP_K) == choose(other, uniform, FORCED_TOP_K)
        )
    alike = torch.cat(same)
    share = float(alike.double().mean())
    exact = row.precision == "float32"
    holds = {"holds": gap <= LOGITS_LIMIT and share >= CHOICES_LIMIT} if exact else {}
    return {"largest_gap": gap, "same": share, "choices": len(alike), **holds}


def measure_training(row: Row, place: Place) -> dict[str, Any]:
    """Measure optimizer steps."""
    step = _training_step(row, place)
    with repeatable():
        with FlopCounterMode(display=False) as counter:
            step()
        found = _repeat(step, place)
    flops = counter.get_total_flops() / row.batch
    precision = "bf16" if row.precision == "bf16" else "float32"
    return _figures(found, row, place, precision, flops, steps=1)


def _training_step(row: Row, place: Place) -> Callable[[], object]:
    case = training.Case(row.size, row.batch, 0, place.device, place.threads, row.precision)
    optimizer_step, batch, _ = training.prepare(case, place.scene())
    return lambda: optimizer_step.step([batch], range(1), 0)


def measure_rollouts(row: Row, place: Place) -> dict[str, Any]:
    """Measure token steps of rollouts, with the default settings."""
    start = time.perf_counter()
    session = _session(row, place)
    await_device(place.device)
    begin_s = time.perf_counter() - start
    session.step()
    return {**_token_steps(session, row, place), "begin_s": begin_s}


def measure_graphs(row: Row, place: Place) -> dict[str, Any]:
    """Measure the same with passes of insertion as CUDA graphs, and whether they insert so.

    On a CPU there are none.
    """
    plain = _session(row, place)
    captured = _session(row, place, cuda_graphs=True)
    same = [_share_alike(plain.step(), captured.step()) for _ in range(GRAPH_STEPS)]
    del plain
    return {**_token_steps(captured, row, place), "same": float(np.mean(same))}


def _share_alike(one: Frame, other: Frame) -> float:
    """Share of rollouts with the same agents at the same places."""
    alike = (one.agent_number == other.agent_number).all(axis=1)
    alike &= (one.inserted_number == other.inserted_number).all(axis=1)
    gap_m = np.abs(one.path - other.path).max(axis=(1, 2, 3))
    return float((alike & (gap_m < SAME_PLACE_M)).mean())


def _token_steps(session: Session, row: Row, place: Place) -> dict[str, Any]:
    """Measure token steps of a session that has been stepped before."""
    found = _repeat(session.step, place)
    precision = describe_precision(row.precision, torch.device(place.device).type)
    steps, flops = CLOCK.tokens_in(ROLLOUT_S), _flops_of_a_step(row.size, place)
    return _figures(found, row, place, precision, flops, steps=steps)


@cache
def _flops_of_a_step(size: str, place: Place) -> float:
    """Products of a token step of one rollout; they are counted in float32 only."""
    session = _session(Row("rollouts", size, FEW, "float32"), place)
    with FlopCounterMode(display=False) as counter:
        session.step()
    return counter.get_total_flops() / FEW


def _session(row: Row, place: Place, *, cuda_graphs: bool = False) -> Session:
    agents, roads = (6, 100) if place.small else (0, 0)
    case = rollout.Case(
        row.size, row.batch, "long", "masked", ROLLOUT_S, agents, roads, place.device,
        place.threads, row.precision, cuda_graphs,
    )  # fmt: skip
    session, _ = rollout.make_session(case, place.scene())
    return session


@dataclass(frozen=True, slots=True)
class _Repeated:
    """Mean seconds of a step, how many were done, and the most memory."""

    step_s: float
    steps: int
    peak_mib: float


def _repeat(step: Callable[[], object], place: Place) -> _Repeated:
    """Do a step to warm up, then again for some time."""
    step()
    await_device(place.device)
    start, steps = time.perf_counter(), 0
    while not steps or time.perf_counter() - start < place.row_s:
        step()
        await_device(place.device)
        steps += 1
    step_s = (time.perf_counter() - start) / steps
    return _Repeated(step_s, steps, peak_mib(place.device))


def _figures(
    found: _Repeated, row: Row, place: Place, precision: str, flops: float, *, steps: int
) -> dict[str, Any]:
    """Figures of a row.

    Args:
        found: Its steps.
        row: The row.
        place: Where.
        precision: Of the peak that it is compared with.
        flops: Products of a step for one scene or rollout.
        steps: How many steps one takes.
    """
    peak, source = find_peak(
        place.name, place.device, precision, SMALL_SIDE if place.small else None
    )
    return {
        "per_s": row.batch / found.step_s / steps,
        "step_ms": 1e3 * found.step_s,
        "steps": found.steps,
        "gflop_each": flops * steps / 1e9,
        "of_peak": flops * row.batch / found.step_s / peak,
        "peak": source,
        "peak_mib": found.peak_mib,
    }


def measure_kernels(row: Row, place: Place) -> dict[str, Any]:
    """Find the dearest kernels of an optimizer step and of a token step."""
    found = {}
    for name, step in (
        ("training", _training_step(row, place)),
        ("rollouts", _session(row, place).step),
    ):
        step()
        found[name] = _dearest(step, place)
    return found


def _dearest(step: Callable[[], object], place: Place) -> list[tuple[str, float, int]]:
    """Name, milliseconds and calls of the dearest kernels of a step."""
    from torch.profiler import ProfilerActivity, profile  # noqa: PLC0415

    on_cuda = torch.device(place.device).type == "cuda"
    with profile(
        activities=[ProfilerActivity.CUDA] if on_cuda else [ProfilerActivity.CPU]
    ) as profiled:
        step()
        await_device(place.device)
    what = "self_device_time_total" if on_cuda else "self_cpu_time_total"
    kernels = sorted(profiled.key_averages(), key=lambda each: -getattr(each, what))
    return [
        (str(each.key), getattr(each, what) / 1e3, int(each.count))
        for each in kernels[:DEAREST]
    ]


MEASURES: dict[str, Callable[[Row, Place], dict[str, Any]]] = {
    "logits": measure_logits,
    "choices": measure_choices,
    "training": measure_training,
    "rollouts": measure_rollouts,
    "graphs": measure_graphs,
    "kernels": measure_kernels,
}
