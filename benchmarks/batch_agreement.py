"""How often a rollout played alone and one played among others are the same.

A rollout has its own random numbers, so what it does depends on nobody beside it, but for
the last bits of sums, whose order depends on how much is computed at once. A draw that
falls within those bits of a boundary between two choices comes out otherwise; from then on
the two are different futures, each as good as the other. This counts how often::

    python benchmarks/batch_agreement.py [--rollouts 32] [--seconds 30] [--scenes 1]
        [--weights ROOT/latest/train] [--mode long]

Every scene is played once with all its rollouts in one batch, and with each of them alone,
token step by token step; a rollout is followed until something sampled is not the same
(moves, who enters where and as what, who leaves). Without ``--weights`` the network is
random, of size small, and as lively as the log (``benchmarks/rollout.py``). The last line
is one JSON object.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from made_vocabularies import made_vocabularies
from measuring import read_scene
from records import read_split
from rollout import Case, ThroughputMeter, make_network

from infgen.clock import CLOCK
from infgen.config import RolloutSettings, TokenSettings
from infgen.model.network import Network
from infgen.model.relations import Rows
from infgen.model.step_memory import StepMemory
from infgen.model.stepping import Stepper
from infgen.model.token_step import MotionStep, TokenStep
from infgen.rollout.population import Population
from infgen.rollout.recording import RolloutStart
from infgen.rollout.session import Session
from infgen.rollout.simulator import Simulator
from infgen.scene import Scene
from infgen.tokens.tokenizer import tokenize_scene
from pipeline.storage.weights import load_network

SAMPLED = ("agent_number", "agent_type", "motion_token", "presence")


class Saying(Stepper):
    """A stepper that keeps what it said last."""

    said: MotionStep | None = None

    def motion_step(
        self, memory: StepMemory, token_step: TokenStep, rows: Rows | None = None
    ) -> MotionStep:
        """Append a column to the past and say what follows it."""
        self.said = super().motion_step(memory, token_step, rows)
        return self.said


@dataclass(frozen=True, slots=True)
class Followed:
    """One rollout, alone and among others.

    Attributes:
        half_seconds: How many were the same.
        parted: What was not in the next one; empty if they stayed together.
        gap: Largest difference between logits of moves while they were together.
    """

    half_seconds: int
    parted: str
    gap: float


def follow(
    network: Network, scene: Scene, settings: RolloutSettings, rollouts: int
) -> Iterator[Followed]:
    """Play all rollouts of a scene in step, together and each alone."""
    books = network.motion_vocabulary(), network.map_vocabulary()
    tokens = network.grid_settings
    history = tokenize_scene(scene, *books, tokens, until=scene.now)
    starts = [RolloutStart(scene, history, at, settings.seed) for at in range(rollouts)]

    def session(of: Sequence[RolloutStart]) -> tuple[Session, Saying]:
        saying = Saying(network)
        player = Simulator(saying, *books, tokens, settings, torch.device("cpu"))
        return Session(player, of), saying

    together, all_say = session(starts)
    alone = {at: session([start]) for at, start in enumerate(starts)}
    gaps = dict.fromkeys(alone, 0.0)
    steps = CLOCK.tokens_in(settings.duration_s)
    for step in range(steps):
        together.step()
        for at, (single, says) in list(alone.items()):
            single.step()
            parted = _parted(single.population, together.population, at)
            if parted:
                del alone[at]
                yield Followed(step, parted, gaps[at])
                continue
            gaps[at] = max(gaps[at], _gap(says.said, all_say.said, at))
    for at in alone:
        yield Followed(steps, "", gaps[at])


def _parted(single: Population, together: Population, at: int) -> str:
    """Name what was sampled otherwise; empty if nothing was."""
    differ = [
        name
        for name in SAMPLED
        if not np.array_equal(getattr(single, name)[0], getattr(together, name)[at])
    ]
    return "insertions" if "agent_number" in differ else " and ".join(differ)


def _gap(single: MotionStep | None, together: MotionStep | None, at: int) -> float:
    assert single is not None
    assert together is not None
    away = single.motion_logits[0] - together.motion_logits[at]
    return float(away.abs().max())


def _scenes(count: int) -> list[Scene]:
    """The scene that figures are about, then others of the validation split."""
    return [read_scene(), *islice(read_split("validation"), count - 1)]


def _network(weights: Path | None, scene: Scene) -> Network:
    if weights is not None:
        return load_network(weights).eval()
    case = Case("small", 1, "long", "plain", 0.0, 0, 0, "cpu", 1)
    motion, roads = made_vocabularies()
    tokens = tokenize_scene(scene, motion, roads, TokenSettings())
    return make_network(case, ThroughputMeter.of(tokens))


def main() -> None:
    """Follow rollouts of some scenes, and print what became of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rollouts", type=int, default=32)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--scenes", type=int, default=1)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--mode", default="long")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    settings = RolloutSettings(mode=asked.mode, seconds=asked.seconds)
    found: list[Followed] = []
    for scene in _scenes(asked.scenes):
        network = _network(asked.weights, scene)
        for one in follow(network, scene, settings, asked.rollouts):
            found.append(one)
            if one.parted:
                print(
                    f"{scene.scenario_id}: {one.parted} at half second {one.half_seconds}"
                )
    parted = [one.half_seconds for one in found if one.parted]
    same = len(found) - len(parted)
    print(f"{same} of {len(found)} rollouts are the same in every token")
    figures = {
        "rollouts": len(found),
        "same": same,
        "half_seconds_together": sum(one.half_seconds for one in found),
        "half_seconds_until_they_part": sorted(parted),
        "largest_gap_of_move_logits": max(one.gap for one in found),
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
