"""How often do agents take motion tokens after which braking no longer averts an overlap?

Logs, and rollouts of some weights without rules but the insertion mask, as policy gradient
simulates them (``infgen/model/training/policy_gradient/avoided/conflicts.py``)::

    python benchmarks/conflicts.py ROOT [--weights ROOT/latest/train]
        [--split validation] [--scenes 20]

The table has the share of motion tokens that are in conflict, how many overlaps begin in a
thousand motion tokens, and how many of these were foreseen: in an earlier token step,
within the look-ahead, the agent that runs into the other one took a motion token in
conflict. The last line is one JSON object.
"""

import json
from collections import Counter
from collections.abc import Sequence

import torch
from logged_scenes import asked, whole

from infgen.model.batching.batch import Batch
from infgen.model.latent_rates import Rate
from infgen.model.network import Network
from infgen.model.training.policy_gradient.avoided.braking import LOOK_AHEAD_TOKENS
from infgen.model.training.policy_gradient.avoided.conflicts import conflicts_taken
from infgen.model.training.policy_gradient.rewards import find_costs
from infgen.model.training.policy_gradient.road import read_roads
from infgen.model.training.policy_gradient.rollouts import (
    HISTORY_TOKENS,
    SimulatedRollouts,
    simulate_rollouts,
)
from infgen.rollout.settings import RolloutSettings
from infgen.tokens.scene_tokens import Presence
from pipeline.commands.screen import show_table

ROLLOUTS = 4
"""Rollouts of each scene."""
TOP_P = 0.9
"""Share of the probability that motion tokens are sampled from."""


def logged_moves(network: Network, batch: Batch) -> SimulatedRollouts:
    """Take the motion tokens of a log for those that were sampled."""
    agents, visible = batch.agents, batch.agents.visible
    count = network.motion_vocabulary().num_motion_tokens
    moved = agents.observed & visible.roll(1, dims=1)
    moved &= (agents.motion_token >= 0) & (agents.motion_token < count)
    moved[:, :HISTORY_TOKENS] = False
    inserted = agents.presence == int(Presence.INSERTED)
    inserted[:, :HISTORY_TOKENS] = False
    none = torch.zeros((*visible.shape[:2], len(Rate)))
    return SimulatedRollouts(batch, agents, 1, moved, inserted, visible[:, 1], none)


def count(network: Network, rollouts: SimulatedRollouts) -> Counter[str]:
    """Count motion tokens, those in conflict, and overlaps."""
    vocabulary = network.motion_vocabulary()
    roads = read_roads(rollouts.batch.roads, network.map_vocabulary())
    overlap = find_costs(rollouts, vocabulary, roads).overlap & rollouts.moved
    conflict = torch.from_numpy(conflicts_taken(rollouts, vocabulary))
    before = torch.zeros_like(conflict)  # The token of the overlap itself is always one.
    for later in range(1, LOOK_AHEAD_TOKENS):
        before[:, later:] |= conflict[:, :-later]
    counted = {
        "moves": rollouts.moved,
        "conflicts": conflict,
        "overlaps": overlap,
        "foreseen": overlap & before,
    }
    return Counter({name: int(some.sum()) for name, some in counted.items()})


def report(found: dict[str, Counter[str]]) -> list[dict[str, object]]:
    """Print the table; return its rows."""
    rows: list[dict[str, object]] = [
        {
            "of": name,
            "moves": total["moves"],
            "conflicts": total["conflicts"] / max(1, total["moves"]),
            "overlaps": total["overlaps"] / max(1, total["moves"]),
            "foreseen": total["foreseen"] / max(1, total["overlaps"]),
        }
        for name, total in found.items()
    ]
    show_table(
        "motion tokens in conflict",
        ("of", "motion tokens", "in conflict", "overlaps per 1,000", "of these foreseen"),
        [
            (
                r["of"],
                r["moves"],
                f"{r['conflicts']:.2%}",
                f"{1000 * float(str(r['overlaps'])):.2f}",
                f"{r['foreseen']:.0%}",
            )
            for r in rows
        ],
    )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Look at logs and rollouts of a root's tokens."""
    network, scenes = asked(__doc__, arguments)
    found: dict[str, Counter[str]] = {"logs": Counter(), "rollouts": Counter()}
    for seed, scene in enumerate(scenes):
        batch = whole(network, scene)
        simulated = simulate_rollouts(
            network,
            batch,
            ROLLOUTS,
            TOP_P,
            seed,
            insertion_mask=True,
            latent_rate_scale=RolloutSettings().latent_rate_scale,
        )
        for name, each in zip(
            found, (logged_moves(network, batch), simulated), strict=True
        ):
            found[name] += count(network, each)
    print(json.dumps({"rows": report(found)}))


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
