"""What each way to tell attention relative poses costs, on a CPU, side by side.

Features of every pair of neighbours as wide as all others (the paper's), narrow ones
(``model.relation_width``), and none (``model.relations=rotary``)::

    python benchmarks/relative_poses.py [--size paper] [--repeats 3] [--steps 10]

On the scene of ``training.py`` and ``rollout.py``: optimizer steps of one scene, and token
steps of rollouts. All in one process and one thread, the ways in turns; of every step the
least of the repeats counts, as others may use the machine. The last line is one JSON
object.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from typing import Literal

import rollout
import torch
import training
from measuring import used_s

from infgen.clock import CLOCK
from pipeline.commands.screen import show_table
from pipeline.stages.train.setup import repeatable

WAYS = {"features": "", "narrow features": "-narrow", "rotary": "-rotary"}
"""Endings of the names of sizes."""
AT_ONCE = 8
COLUMNS = {
    "training step": "CPU-s a scene",
    "motion-only": "CPU-ms a token step and rollout",
    "long": "the same with insertion",
}

Work = Callable[[int], object]
"""Does the step of this number."""


def optimizer_steps(size: str) -> Work:
    """Prepare optimizer steps of one scene."""
    descent, batch, _ = training.prepare(
        training.Case(size, 1, 0, "cpu", 1, precision="float32")
    )
    return lambda step: descent.step([batch], range(1), step)


def token_steps(size: str, mode: Literal["long", "motion-only"], steps: int) -> Work:
    """Prepare token steps of rollouts."""
    seconds = max(1, steps) / CLOCK.tokens_in(1.0)
    case = rollout.Case(size, AT_ONCE, mode, "plain", seconds, 0, 0, "cpu", 1)
    session, _ = rollout.make_session(case)
    return lambda _: session.step()


def least_s(
    prepare: Callable[[str], Work], size: str, steps: int, repeats: int
) -> dict[str, float]:
    """Mean over the steps of the least seconds that each took, by way."""
    least = {way: [float("inf")] * steps for way in WAYS}
    for _ in range(repeats):
        work = {way: prepare(size + ending) for way, ending in WAYS.items()}
        for step in range(steps):
            for way, do in work.items():
                start_s = used_s("cpu")
                do(step)
                least[way][step] = min(least[way][step], used_s("cpu") - start_s)
    return {way: sum(each) / steps for way, each in least.items()}


def measure(size: str, steps: int, repeats: int) -> dict[str, dict[str, float]]:
    """Measure all columns, each by way."""
    with repeatable():
        found = {"training step": least_s(optimizer_steps, size, 3, repeats)}
    for mode in ("motion-only", "long"):
        each = least_s(lambda at: token_steps(at, mode, steps), size, steps, repeats)  # noqa: B023
        found[mode] = {way: 1e3 * spent / AT_ONCE for way, spent in each.items()}
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all columns and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", choices=("paper", "small"), default="paper")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--steps", type=int, default=10)
    asked = parser.parse_args(arguments)
    torch.set_num_threads(1)
    found = measure(asked.size, asked.steps, asked.repeats)
    show_table(
        f"relative poses, {asked.size}, {AT_ONCE} rollouts at once",
        ("relative poses", *(f"{name}, {unit}" for name, unit in COLUMNS.items())),
        [(way, *(f"{found[name][way]:.3f}" for name in COLUMNS)) for way in WAYS],
    )
    print(json.dumps({"size": asked.size, **found}))


if __name__ == "__main__":
    main()
