"""What steps of the environment cost: a batch beside a loop of single ones, and its memory.

    python benchmarks/environment.py [--environments 32] [--steps 600] [--loop-steps 100]

Weights, settings and scenes are those of the package; all egos follow their routes, and
episodes that end begin anew. Every row is a process of its own. Memory is what the process
holds at quarters of the run, after its first quarter has filled caches: it grows by no more
than ``--most-growth-mib`` or the script fails. The last line is one JSON object.
"""

import argparse
import gc
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from measuring import in_own_process, used_s

from infgen.environment import ID
from pipeline.commands.screen import show_table

BATCH, LOOP = "a batch", "a loop of single ones"
PARTS = 4
PAGE_MIB = 4096 / 2**20
DESIRED_MPS = 8.0


def follow_routes(observation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Actions [..., 2] that lead along routes at a constant speed, whoever is there."""
    speed_mps = observation["ego"][..., 0]
    x_m, y_m = np.moveaxis(observation["route"][..., 0, :], -1, 0)
    steering_rad = 3.0 * 2 * y_m / np.maximum(x_m**2 + y_m**2, 1.0)
    return np.stack([DESIRED_MPS - speed_mps, steering_rad], axis=-1).astype(np.float32)


def held_mib() -> float:
    """Memory that this process holds now."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE_MIB


def drive_batch(environments: int, steps: int, seed: int) -> dict[str, Any]:
    """Drive a batch; returns what it cost."""
    env = gymnasium.make_vec(ID, num_envs=environments)
    observation, _ = env.reset(seed=seed)
    held, ends, agents = [], 0, 0.0
    begun = time.perf_counter(), used_s("cpu")
    for step in range(1, steps + 1):
        observation, _, ended, cut, info = env.step(follow_routes(observation))
        ends += int((ended | cut).sum())
        agents += float(info["agents"].mean())
        if step % max(1, steps // PARTS) == 0:
            held.append(held_mib())
    return _figures(environments * steps, begun, ends, agents / steps, held)


def drive_loop(environments: int, steps: int, seed: int) -> dict[str, Any]:
    """Drive as many single environments one after the other; returns what it cost."""
    envs = [gymnasium.make(ID, disable_env_checker=True) for _ in range(environments)]
    seen = [env.reset(seed=seed + at)[0] for at, env in enumerate(envs)]
    held, ends, agents = [], 0, 0.0
    begun = time.perf_counter(), used_s("cpu")
    for step in range(1, steps + 1):
        for at, env in enumerate(envs):
            seen[at], _, ended, cut, info = env.step(follow_routes(seen[at]))
            agents += info["agents"] / environments
            if ended or cut:
                ends += 1
                seen[at] = env.reset()[0]
        if step % max(1, steps // PARTS) == 0:
            held.append(held_mib())
    return _figures(environments * steps, begun, ends, agents / steps, held)


def _figures(
    steps: int, begun: tuple[float, float], ends: int, agents: float, held: list[float]
) -> dict[str, Any]:
    passed_s, spent_s = time.perf_counter() - begun[0], used_s("cpu") - begun[1]
    return {
        "steps": steps,
        "steps_per_s": steps / passed_s,
        "steps_per_cpu_s": steps / spent_s,
        "cpu_ms_per_step": 1e3 * spent_s / steps,
        "episodes_ended": ends,
        "agents": agents,
        "held_mib": [round(mib, 1) for mib in held],
        "growth_mib": round(held[-1] - held[0], 1),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table and the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--environments", type=int, default=32)
    parser.add_argument("--steps", type=int, default=600, help="of the batch, each")
    parser.add_argument("--loop-steps", type=int, default=50, help="of the loop, each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--most-growth-mib", type=float, default=64.0)
    parser.add_argument("--case", type=json.loads, help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    if asked.case:
        torch.set_num_threads(asked.case.pop("threads"))
        drive = {BATCH: drive_batch, LOOP: drive_loop}[asked.case.pop("row")]
        print(json.dumps(drive(**asked.case)))
        return
    common = {
        "environments": asked.environments, "seed": asked.seed, "threads": asked.threads
    }  # fmt: skip
    found = {}
    for row, steps in ((BATCH, asked.steps), (LOOP, asked.loop_steps)):
        print(f"{asked.environments} environments x {steps} steps: {row}", file=sys.stderr)
        found[row] = in_own_process(Path(__file__), {**common, "row": row, "steps": steps})
    show_table(
        f"{asked.environments} environments at 10 Hz",
        ("driven as", "steps/s", "steps/CPU-s", "ended", "agents", "MiB held at quarters"),
        [
            (
                name,
                f"{row['steps_per_s']:.0f}",
                f"{row['steps_per_cpu_s']:.0f}",
                f"{row['episodes_ended']:.0f}",
                f"{row['agents']:.0f}",
                " ".join(f"{mib:.0f}" for mib in row["held_mib"]),  # type: ignore[attr-defined]
            )
            for name, row in found.items()
        ],
    )
    print(json.dumps({"batch": found[BATCH], "loop": found[LOOP]}))
    if found[BATCH]["growth_mib"] > asked.most_growth_mib:
        sys.exit(f"memory has grown by {found[BATCH]['growth_mib']} MiB")


if __name__ == "__main__":
    main()
