"""What benchmarks of the network share: the scene, the sizes, and honest seconds."""

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
from records import SHARED, read_split
from torch import Tensor

from infgen.config import ModelSettings
from infgen.scene import Scene
from infgen.sources.womd import iter_scenes

SCENE = "637f20cafde22ff8"
RECORD = SHARED.parents[1] / "golden" / "wosac" / SCENE / "scenario.tfrecord"
_SMALL = ModelSettings(
    width=48, heads=4, map_blocks=1, motion_blocks=2, scene_blocks=1, fourier_bands=16
)
_TINY = ModelSettings(
    width=16, heads=2, map_blocks=1, motion_blocks=1, scene_blocks=1, fourier_bands=4
)
SIZES = {
    "paper": ModelSettings(),
    "paper-narrow": ModelSettings(relation_width=32),
    "paper-narrow-16": ModelSettings(relation_width=16),
    "paper-rotary": ModelSettings(relations="rotary"),
    "small": _SMALL,
    "small-narrow": replace(_SMALL, relation_width=16),
    "small-rotary": replace(_SMALL, relations="rotary"),
    "tiny": _TINY,
}
"""Sizes of the network by name; the narrow ones have narrow features of relative poses,
the rotary ones none, and the tiny one is for tests."""
PEAK_SIDE = 2048


@cache
def read_scene() -> Scene:
    """Read the scene that figures are about, or the largest built-in one."""
    if RECORD.is_file():
        return next(s for s in iter_scenes(RECORD) if isinstance(s, Scene))
    return max(read_split("training"), key=lambda scene: len(scene.tracks.id))


@cache
def read_small_scene() -> Scene:
    """Read the built-in scene with the fewest agents, for tests."""
    return min(read_split("training"), key=lambda scene: len(scene.tracks.id))


def is_cpu(device: str) -> bool:
    """Whether this is no accelerator."""
    return torch.device(device).type == "cpu"


def await_device(device: str) -> None:
    """Wait until a device has done all that it was asked for."""
    if not is_cpu(device):
        torch.get_device_module(device).synchronize()


def used_s(device: str) -> float:
    """Seconds used so far: of the processor, or of the clock for a GPU."""
    if not is_cpu(device):
        await_device(device)
        return time.perf_counter()
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def seconds(work: Callable[[], object], times: int, device: str) -> float:
    """Mean seconds that a call uses."""
    start = used_s(device)
    for _ in range(times):
        work()
    return (used_s(device) - start) / times


def peak_mib(device: str) -> float:
    """Most memory that this process has held: of the machine, or of the GPU."""
    if not is_cpu(device):
        return float(torch.get_device_module(device).max_memory_allocated()) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def multiplies_bf16(device: str) -> bool:
    """Whether products of a GPU are at their fastest in bfloat16."""
    is_cuda = torch.device(device).type == "cuda"
    return is_cuda and torch.cuda.is_bf16_supported()


def peak_flops(device: str, *, bf16: bool, side: int | None = None) -> float:
    """Operations a second (of the clock) of a product of large matrices."""
    side = side or PEAK_SIDE
    dtype = torch.bfloat16 if bf16 else torch.float32
    one = torch.randn(side, side, device=device, dtype=dtype)
    other, best = one.clone(), 0.0

    def product() -> Tensor:
        return one @ other

    product()
    for _ in range(5):
        start = time.perf_counter()
        seconds(product, 4, device)
        best = max(best, 4 * 2 * side**3 / (time.perf_counter() - start))
    return best


def in_own_process(script: Path, case: Mapping[str, Any]) -> dict[str, float]:
    """Measure one row of a script in a fresh process, which prints it as JSON at last."""
    command = [sys.executable, str(script), "--case", json.dumps(case)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found
