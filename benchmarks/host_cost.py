"""What the host does in a rollout, outside the network and outside sampling from logits.

Rollouts are played by a small network with random weights, as in ``rollout.py``; processor
time within the network and within sampling, which run on a device where there is one, is
not counted. What is left is the cost of the engine: populations, rules, random numbers::

    python benchmarks/host_cost.py [--batches 32,64,256] [--seconds 5] [--lines 15]

``--lines`` prints the functions that cost most in the last row. The last line is JSON.
"""

import argparse
import cProfile
import json
import pstats
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from measuring import in_own_process
from rollout import LENGTH_S, PLAYED, Case, make_session

from infgen.clock import CLOCK
from infgen.model.insertion.detail_query import DetailQuery
from infgen.model.stepping import Stepper
from infgen.rollout import insertion, motion_sampler
from infgen.rollout.session import Session
from pipeline.commands.screen import show_table

NETWORK = {
    Stepper: (
        *("begin", "motion_step", "entry_begin", "entry_add"),
        *("entry_query", "entry_details"),
    ),
    DetailQuery: ("offset_logits", "heading_logits"),
}
"""Calls of the network."""
SAMPLING = {
    insertion: ("choose", "sample_event"),
    motion_sampler: ("choose", "sample_event"),
}
"""Functions that sample from logits, by the module that calls them."""


@dataclass(slots=True)
class Excluded:
    """Processor time within the functions that are not counted.

    Attributes:
        used_s: The time.
        held: What each returned, until it is called again: so that its memory is freed at
            its cost, and not where the caller drops the last reference.
        running: Whether one of them runs: what it calls of them is a part of its time.
    """

    used_s: float = 0.0
    held: dict[str, Any] = field(default_factory=dict)
    running: bool = False

    def wrap(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function whose processor time is added up here."""

        def timed(*arguments: Any, **named: Any) -> Any:
            if self.running:
                return function(*arguments, **named)
            self.running, start = True, time.process_time()
            self.held.pop(function.__qualname__, None)
            found = self.held[function.__qualname__] = function(*arguments, **named)
            self.running, self.used_s = False, self.used_s + time.process_time() - start
            return found

        return timed


def measure(batch: int, played: str, seconds: float, lines: int) -> dict[str, float]:
    """Measure one row, in this process."""
    torch.set_num_threads(1)
    excluded = Excluded()
    for module, names in (*NETWORK.items(), *SAMPLING.items()):
        for name in names:
            setattr(module, name, excluded.wrap(getattr(module, name)))
    motion_only = played == "motion only"
    session, _ = make_session(
        Case(
            "small", batch, "motion-only" if motion_only else "long",
            "plain" if motion_only else played, seconds, 0, 0, "cpu", 1,
        )
    )  # fmt: skip
    session.step()  # What is made once is not part of it.
    profile = cProfile.Profile(time.process_time) if lines else None
    row = _steps(session, excluded, CLOCK.tokens_in(seconds), profile)
    if profile is not None:
        stats = pstats.Stats(profile, stream=sys.stderr).sort_stats("tottime")
        stats.print_stats(r"infgen/(rollout|tokens|geometry|spatial)|numpy", lines)
    return row


def _steps(
    session: Session, excluded: Excluded, steps: int, profile: cProfile.Profile | None
) -> dict[str, float]:
    """Simulate some token steps and say what they cost."""
    excluded.used_s, start, agents, inserted = 0.0, time.process_time(), 0, 0
    if profile is not None:
        profile.enable()
    for _ in range(steps):
        frame = session.step()
        agents += int((frame.agent_number >= 0).sum())
        inserted += int((frame.inserted_number >= 0).sum())
    if profile is not None:
        profile.disable()
    host_s = time.process_time() - start - excluded.used_s
    rollouts = len(session.ego_pose)
    return {
        "agents": agents / steps / rollouts,
        "inserted": inserted / steps / rollouts,
        "ms_per_step": 1e3 * host_s / steps,
        "ms_per_rollout": 1e3 * host_s / steps / rollouts * LENGTH_S / CLOCK.token_s,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all rows, or the one that another process asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--batches", default="32,64,256")
    parser.add_argument("--played", default=",".join(("motion only", *PLAYED)))
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--lines", type=int, default=0)
    parser.add_argument("--case", type=json.loads, help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    if asked.case:
        print(json.dumps(measure(**asked.case)))
        return
    found: dict[str, dict[str, float]] = {}
    for played in asked.played.split(","):
        for batch in map(int, asked.batches.split(",")):
            case = _Row(batch, played, asked.seconds, asked.lines)
            found[f"{played}, {batch} at once"] = in_own_process(
                Path(__file__), asdict(case)
            )
    show_table(
        "host time outside the network and sampling",
        ("rollouts", "agents", "inserted a step", "ms a step", f"ms per {LENGTH_S:g} s"),
        [
            (name, *(f"{value:.3g}" for value in row.values()))
            for name, row in found.items()
        ],
    )
    print(json.dumps(found))


@dataclass(frozen=True, slots=True)
class _Row:
    """One row of the table: what ``measure`` is given."""

    batch: int
    played: str
    seconds: float
    lines: int


if __name__ == "__main__":
    main()
