"""What one scene costs in a training step: forward, backward and update.

On the scene that all such figures of ours are about (637f20cafde22ff8), or on the largest
built-in one where it is absent::

    python benchmarks/training.py [--size paper] [--threads 2] [--device cpu]
        [--precision auto]

One row has products of half the bits, which pay on processors that multiply bfloat16. One
has as many processes as there are threads, of one thread and one scene each, which add up
their gradients as under ``torchrun``. Every row is a process of its own, so its memory is
too. The last line is one JSON object:
``cpu_s_per_scene`` and ``peak_rss_mib`` of the first row, one scene a step, and
``flops_over_peak``: multiply-adds of matrix products a second over those of a plain product
of large matrices in the same process. On a GPU seconds are the clock's.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.distributed as dist
from made_vocabularies import made_vocabularies
from measuring import (
    SIZES,
    in_own_process,
    peak_flops,
    peak_mib,
    read_scene,
    seconds,
)
from torch.utils.flop_counter import FlopCounterMode

from infgen.config import TokenSettings, TrainSettings
from infgen.model.batching.batch import Batch, Limits, collate, to_device
from infgen.model.network import Network
from infgen.scene import Scene
from infgen.tokens.tokenizer import tokenize_scene
from pipeline.commands.screen import show_table
from pipeline.stages.train.optimizer_step import OptimizerStep
from pipeline.stages.train.process_group import ProcessGroup
from pipeline.stages.train.setup import repeatable
from pipeline.storage.checkpoint import TrainingState

FEW_NEIGHBOURS = 5
"""Map tokens per agent that the public reference sees."""
STEPS = 3
ONE_EACH = "one scene in each of as many processes of one thread"


@dataclass(frozen=True, slots=True)
class Case:
    """One row of the table.

    Attributes:
        size: ``paper`` or ``small``.
        scenes: Scenes of a step.
        neighbours: Map tokens that an agent sees; 0 for the default.
        device: Where.
        threads: Of the processor.
        precision: As in ``TrainSettings``.
        team: Processes that do a step together ...
        rank: ... the number of this one ...
        meeting: ... and the file by which they find each other.
    """

    size: str
    scenes: int
    neighbours: int
    device: str
    threads: int
    precision: Literal["auto", "float32", "bf16"]
    team: int = 1
    rank: int = 0
    meeting: str = ""


def prepare(
    case: Case, scene: Scene | None = None
) -> tuple[OptimizerStep, Batch, TrainingState]:
    """Make the network, its optimiser, and a batch of one scene several times.

    Args:
        case: The row.
        scene: The scene; None for the one that figures are about.
    """
    model = SIZES[case.size]
    if case.neighbours:
        model = replace(model, map_agent_neighbours=case.neighbours)
    grid, how = TokenSettings(), TrainSettings(precision=case.precision)
    motion, roads = made_vocabularies()
    tokens = tokenize_scene(scene or read_scene(), motion, roads, grid)
    batch = collate([tokens] * case.scenes, Limits.of(model, how, grid), 0)
    torch.manual_seed(0)
    team = _join(case)
    device = team.device
    network = Network(model, motion, roads, grid).to(device)
    optimiser = torch.optim.AdamW(network.parameters(), fused=True)
    average = {name: p.detach().clone() for name, p in network.named_parameters()}
    training = TrainingState(network, average, optimiser)
    descent = OptimizerStep(training, how, team, case.team)
    return descent, to_device(batch, device), training


def _join(case: Case) -> ProcessGroup:
    device = torch.device(case.device)
    if case.team > 1:
        where = f"file://{case.meeting}"
        dist.init_process_group("gloo", where, rank=case.rank, world_size=case.team)
    return ProcessGroup(case.rank, case.team, device)


def measure(case: Case) -> dict[str, float]:
    """Measure one row, in this process."""
    torch.set_num_threads(case.threads)
    descent, batch, training = prepare(case)
    own = range(case.rank, case.rank + 1)
    with repeatable():
        with FlopCounterMode(display=False) as counter:
            descent.step([batch], own, 0)
        start = time.perf_counter()
        used = seconds(lambda: descent.step([batch], own, 1), STEPS, case.device)
        passed_s = (time.perf_counter() - start) / STEPS
    flops = float(counter.get_total_flops())
    peak = peak_flops(case.device, bf16=descent.forward.bf16)
    return {
        "agents": float(batch.agents.visible.sum()) / case.scenes,
        "roads": float(batch.roads.real.sum()) / case.scenes,
        "parameters": float(sum(p.numel() for p in training.network.parameters())),
        "used_s_per_scene": used / case.scenes,
        "clock_s_per_scene": passed_s / case.scenes / case.team,
        "peak_rss_mib": peak_mib(case.device),
        "gflop_per_scene": flops / case.scenes / 1e9,
        "flops_over_peak": flops / passed_s / peak,
    }


def measure_apart(case: Case) -> dict[str, float]:
    """Measure one row in processes of their own: means, but the most memory of any."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(case.team) as pool:
        meeting = str(Path(folder) / "meeting")
        ranks = range(case.team)
        each = [asdict(replace(case, rank=rank, meeting=meeting)) for rank in ranks]
        rows = list(pool.map(partial(in_own_process, Path(__file__)), each))
    found = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return found | {"peak_rss_mib": max(row["peak_rss_mib"] for row in rows)}


def report(first: Case) -> None:
    """Print the table and, last, the figures as JSON."""
    size, device, threads = first.size, first.device, first.threads
    cases = {
        "one scene": first,
        "two scenes": replace(first, scenes=2),
        f"one scene, {FEW_NEIGHBOURS} map tokens per agent": replace(
            first, neighbours=FEW_NEIGHBOURS
        ),
        "one scene, bf16": replace(first, precision="bf16"),
    }
    if device == "cpu" and threads > 1:
        cases[ONE_EACH] = replace(first, team=threads, threads=1)
    found = {name: measure_apart(case) for name, case in cases.items()}
    one = found["one scene"]
    used = "CPU-s" if device == "cpu" else "s"
    show_table(
        f"training step, {size} ({one['parameters']:,.0f} parameters), "
        f"{one['agents']:.0f} agents at a time, {one['roads']:.0f} road tokens",
        (
            "step of",
            f"{used} a scene",
            "clock s",
            "peak MiB",
            "GFLOP a scene",
            "of matmul peak",
        ),
        [
            (
                name,
                f"{row['used_s_per_scene']:.2f}",
                f"{row['clock_s_per_scene']:.2f}",
                f"{row['peak_rss_mib']:.0f}",
                f"{row['gflop_per_scene']:.1f}",
                f"{row['flops_over_peak']:.0%}",
            )
            for name, row in found.items()
        ],
    )
    few = found[f"one scene, {FEW_NEIGHBOURS} map tokens per agent"]
    figures = {
        "size": size,
        "device": device,
        "threads": threads,
        "precision": first.precision,
        "cpu_s_per_scene": round(one["used_s_per_scene"], 3),
        "cpu_s_per_scene_of_two": round(found["two scenes"]["used_s_per_scene"], 3),
        "cpu_s_few_neighbours": round(few["used_s_per_scene"], 3),
        "cpu_s_bf16": round(found["one scene, bf16"]["used_s_per_scene"], 3),
        "peak_rss_mib": round(one["peak_rss_mib"]),
        "gflop_per_scene": round(one["gflop_per_scene"], 1),
        "flops_over_peak": round(one["flops_over_peak"], 3),
    }
    if ONE_EACH in found:
        figures["cpu_s_processes"] = round(found[ONE_EACH]["used_s_per_scene"], 3)
    print(json.dumps(figures))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all rows, or the one that another process asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", choices=sorted(SIZES), default="paper")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--precision", choices=("auto", "float32", "bf16"), default="auto")
    parser.add_argument("--case", type=json.loads, help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    if asked.case:
        print(json.dumps(measure(Case(**asked.case))))
    else:
        report(Case(asked.size, 1, 0, asked.device, asked.threads, asked.precision))


if __name__ == "__main__":
    main()
