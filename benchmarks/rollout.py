"""What a rollout costs: processor seconds, operations, memory, and how they grow.

On the scene that all such figures of ours are about (637f20cafde22ff8), or on the largest
built-in one where it is absent::

    python benchmarks/rollout.py [--size paper] [--threads 1] [--device cpu] [--sweeps]

Weights are random, but for the last layers that decide how lively a scene is: agents enter
and leave as often as in the log of the scene, and slow moves are likelier than fast ones,
so that nobody drives off the map, where there would be nothing to look at.

Every row is a process of its own, so its memory is too. The last line is one JSON object.
On a GPU seconds are the clock's. ``--sweeps`` adds what a rollout costs by the number of
its agents, of its map tokens, by its length, and by the rollouts played at once.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from made_vocabularies import made_vocabularies
from measuring import (
    SIZES,
    in_own_process,
    multiplies_bf16,
    peak_flops,
    peak_mib,
    read_scene,
    used_s,
)
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from infgen.clock import CLOCK
from infgen.config import RolloutSettings, TokenSettings
from infgen.model.network import Network
from infgen.rollout.precision import Precision, make_stepper
from infgen.rollout.recording import Frame, RolloutStart
from infgen.rollout.session import Session
from infgen.rollout.simulator import Simulator
from infgen.scene import Scene
from infgen.tokens.scene_tokens import Presence, SceneTokens
from infgen.tokens.tokenizer import tokenize_scene
from infgen.tokens.vocabulary import MotionVocabulary
from pipeline.commands.screen import show_table

LENGTH_S = 30.0
SWEEP_S = 10.0
"""Length of the rollouts that are compared for other reasons."""
SLOW_M = 0.5
"""Moves so much longer are less likely by a factor of e."""
PLAYED: dict[str, dict[str, Any]] = {
    "plain": {},
    "masked": {
        "rules": "safe",
        "max_motion_samples": 1,
        "reject_off_road": False,
        "max_stall_s": 0.0,
        "density_control": 0.0,
    },
    "safe": {"rules": "safe"},
}
"""Settings by name: no rules, as in the paper; the insertion mask alone; all rules."""


@dataclass(frozen=True, slots=True)
class Case:
    """One row of the table.

    Attributes:
        size: ``paper`` or ``small``.
        batch: Rollouts played at once.
        mode: Of rollouts: ``long`` or ``motion-only``.
        played: One of ``PLAYED``.
        seconds: Length.
        agents: Agents at first, the nearest to the ego; 0 for all.
        roads: Map tokens, the nearest to the ego; 0 for all.
        device: Where.
        threads: Of the processor.
        precision: As in ``RolloutSettings``.
        cuda_graphs: As in ``RolloutSettings``.
    """

    size: str
    batch: int
    mode: Literal["long", "motion-only"]
    played: str
    seconds: float
    agents: int
    roads: int
    device: str
    threads: int
    precision: Precision = "auto"
    cuda_graphs: bool = False


@dataclass(frozen=True, slots=True)
class ThroughputMeter:
    """How lively the log of a scene is.

    Attributes:
        entries: Inserted agents of a half second.
        leaves: Probability that an agent leaves in a half second.
    """

    entries: float
    leaves: float

    @classmethod
    def of(cls, tokens: SceneTokens) -> "ThroughputMeter":
        """Count what happens after now."""
        later = tokens.presence[:, tokens.now + 1 :]
        there = (later != Presence.ABSENT).sum()
        return cls(
            entries=float((later == Presence.INSERTED).sum() / later.shape[1]),
            leaves=float((later == Presence.REMOVED).sum() / max(there, 1)),
        )


def make_network(case: Case, pace: ThroughputMeter) -> Network:
    """Make random weights that play as lively as the log."""
    motion, roads = made_vocabularies()
    torch.manual_seed(0)
    network = Network(SIZES[case.size], motion, roads, TokenSettings())
    assert network.cells is not None
    assert network.motion.leave is not None
    assert network.motion.move is not None
    # One more enters with probability p: p / (1 - p) of them in all.
    _always(network.cells.add, math.log(max(pace.entries, 1e-6)))
    _always(network.motion.leave, math.log(pace.leaves / (1 - pace.leaves) + 1e-9))
    _slowly(network.motion.move, motion)
    return network.to(case.device).requires_grad_(False).eval()


def _always(head: nn.Module, logit: float) -> None:
    """Let a head say one and the same, at the same cost."""
    last = _last_layer(head)
    nn.init.zeros_(last.weight)
    nn.init.constant_(last.bias, logit)


def _slowly(head: nn.Module, vocabulary: MotionVocabulary) -> None:
    """Make long moves of vehicles less likely; the kinds share their outputs."""
    length_m = np.linalg.norm(vocabulary.path[:, :, -1, :2], axis=-1).max(axis=0)
    last = _last_layer(head)
    with torch.no_grad():
        last.bias.sub_(torch.from_numpy(length_m).float() / SLOW_M)


def _last_layer(head: nn.Module) -> nn.Linear:
    last = [part for part in head.modules() if isinstance(part, nn.Linear)][-1]
    assert last.bias is not None
    return last


def make_session(case: Case, scene: Scene | None = None) -> tuple[Session, SceneTokens]:
    """Start a batch of rollouts of a scene, or of the one that figures are about."""
    scene, (motion, roads) = scene or read_scene(), made_vocabularies()
    tokens = TokenSettings()
    network = make_network(
        case, ThroughputMeter.of(tokenize_scene(scene, motion, roads, tokens))
    )
    seen = _near(scene, case.agents, tokens)
    history = tokenize_scene(scene, motion, roads, seen, until=scene.now)
    history = _cropped(history, case.roads)
    settings = RolloutSettings(
        mode=case.mode,
        seconds=case.seconds,
        batch_rollouts=case.batch,
        cuda_graphs=case.cuda_graphs,
        **PLAYED[case.played],
    )
    stepper, device = make_stepper(network, case.precision), torch.device(case.device)
    simulator = Simulator(stepper, motion, roads, tokens, settings, device)
    starts = [RolloutStart(scene, history, at, settings.seed) for at in range(case.batch)]
    return Session(simulator, starts), history


def _near(scene: Scene, agents: int, tokens: TokenSettings) -> TokenSettings:
    """Tokenize the agents nearest to the ego only."""
    if not agents:
        return tokens
    tracks, now = scene.tracks, scene.now
    xy_m = tracks.xyz_m[:, now, :2]
    away_m = np.linalg.norm(xy_m - xy_m[scene.ego], axis=1)[tracks.valid[:, now]]
    farthest_m = float(np.sort(away_m)[min(agents, len(away_m)) - 1])
    return replace(
        tokens, max_ego_distance_m=min(farthest_m + 0.1, tokens.max_ego_distance_m)
    )


def _cropped(history: SceneTokens, roads: int) -> SceneTokens:
    """Keep the map tokens nearest to the ego."""
    if not roads:
        return history
    away_m = history.map_pose[:, :2] - history.pose[history.ego, history.now, :2]
    rows = np.sort(np.argsort(np.linalg.norm(away_m, axis=1), kind="stable")[:roads])
    names = [f.name for f in fields(history) if f.name.startswith("map_")]
    return replace(history, **{name: getattr(history, name)[rows] for name in names})


def measure(case: Case) -> dict[str, float]:
    """Measure one row, in this process."""
    torch.set_num_threads(case.threads)
    start_s, start = used_s(case.device), time.perf_counter()
    session, history = make_session(case)
    begin_s = used_s(case.device) - start_s
    start_s, start = used_s(case.device), time.perf_counter()
    frames = [session.step() for _ in range(CLOCK.tokens_in(case.seconds))]
    spent_s, passed_s = used_s(case.device) - start_s, time.perf_counter() - start
    memory_mib = peak_mib(case.device)
    flops = _flops_of_a_step(session) * len(frames)
    peak = peak_flops(case.device, bf16=multiplies_bf16(case.device))
    return {
        "agents": float(
            np.mean([(frame.agent_number >= 0).sum(axis=1) for frame in frames])
        ),
        "roads": float(history.num_map_tokens),
        "entered": float(np.mean([_entered(frame) for frame in frames]) * len(frames)),
        "begin_s": begin_s,
        "used_s_per_rollout": spent_s / case.batch,
        "used_ms_per_step": 1e3 * spent_s / case.batch / len(frames),
        "rollouts_per_clock_s": case.batch / passed_s,
        "peak_mib": memory_mib,
        "gflop_per_rollout": flops / case.batch / 1e9,
        "flops_over_peak": flops / passed_s / peak,
    }


def _entered(frame: Frame) -> float:
    return float((frame.inserted_number >= 0).sum(axis=1).mean())


def _flops_of_a_step(session: Session) -> float:
    """Operations of matrix products of one more step; counting them takes time itself."""
    with FlopCounterMode(display=False) as counter:
        session.step()
    return float(counter.get_total_flops())


def goals(case: Case) -> dict[str, Case]:
    """Rows that the goals are about."""
    return {
        "motion only, 32 at once": replace(case, mode="motion-only"),
        "entries and exits, 32 at once": case,
        "the same with the insertion mask": replace(case, played="masked"),
        "and with all rules": replace(case, played="safe"),
        "motion only, 1 at once": replace(case, mode="motion-only", batch=1),
        "entries and exits, 1 at once": replace(case, batch=1),
    }


def sweeps(case: Case) -> dict[str, Case]:
    """Rows that show how cost grows."""
    still = replace(case, mode="motion-only", seconds=SWEEP_S, batch=8)
    return {
        **{f"{n} agents at first": replace(still, agents=n) for n in (12, 25, 50)},
        **{f"{n} road tokens": replace(still, roads=n) for n in (250, 500, 1000, 2000)},
        **{f"{n} at once": replace(still, batch=n) for n in (1, 2, 4, 16, 32)},
        **{f"{s:.0f} s": replace(case, seconds=s, batch=4) for s in (30.0, 60.0, 300.0)},
    }


COLUMNS = {
    "agents": ("agents", ".0f"),
    "roads": ("roads", ".0f"),
    "entered": ("entered", ".0f"),
    "used_s_per_rollout": ("CPU-s a rollout", ".2f"),
    "used_ms_per_step": ("ms a step", ".1f"),
    "rollouts_per_clock_s": ("rollouts/s", ".3f"),
    "peak_mib": ("peak MiB", ".0f"),
    "gflop_per_rollout": ("GFLOP a rollout", ".1f"),
    "flops_over_peak": ("of matmul peak", ".0%"),
}


def report(title: str, cases: dict[str, Case]) -> dict[str, dict[str, float]]:
    """Measure rows and print their table."""
    found = {}
    for at, (name, case) in enumerate(cases.items(), start=1):
        print(f"{title}, {at} of {len(cases)}: {name}", file=sys.stderr)
        found[name] = in_own_process(Path(__file__), asdict(case))
    show_table(
        title,
        ("rollouts", *(head for head, _ in COLUMNS.values())),
        [
            (name, *(f"{row[key]:{form}}" for key, (_, form) in COLUMNS.items()))
            for name, row in found.items()
        ],
    )
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all rows, or the one that another process asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", choices=sorted(SIZES), default="paper")
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--seconds", type=float, default=LENGTH_S)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sweeps", action="store_true")
    parser.add_argument("--case", type=json.loads, help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    if asked.case:
        print(json.dumps(measure(Case(**asked.case))))
        return
    case = Case(
        asked.size, asked.batch, "long", "plain", asked.seconds, 0, 0, asked.device,
        asked.threads,
    )  # fmt: skip
    found = report(f"rollouts of {asked.seconds:g} s, {asked.size}", goals(case))
    if asked.sweeps:
        found |= report("how cost grows", sweeps(case))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
