"""Are agents inserted and removed as in logs, where the ego drives and where it stands?

Logs, token step by token step as they are learned from, and what some weights expect::

    python benchmarks/ego_standing.py ROOT [--weights ROOT/latest/train]
        [--split validation] [--scenes 80]

The table has, for egos that drive and for those that stand, how many agents the log inserts
in a token step and how many were expected to be, each turn given the ones before it, and
the share of agents that the log removes at its end and the expected one. Latent rates vary
as in rollouts, half as much as was learned, and expectations are means over them. The last
line is one JSON object.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float64
from logged_scenes import sum_over_logs, whole
from removals import DRIVING_M
from torch import Tensor

from infgen.model.batching.batch import Batch
from infgen.model.batching.supervision import stay_mask
from infgen.model.latent_rates import Rate, RateProcess
from infgen.model.logits import Outputs
from infgen.model.network import Network
from infgen.tokens.scene_tokens import EGO, Presence, SceneTokens
from pipeline.commands.screen import show_table

STATES = ("drives", "stands")
FIGURES = (
    *("token_steps", "inserted", "inserted_expected"),
    *("agents", "removed", "removed_expected"),
)
RATE_SCALE = 0.5


@torch.no_grad()
def look(network: Network, scene: SceneTokens) -> Float64[np.ndarray, "figure state"]:
    """Sum up ``FIGURES`` in a log, by what its ego does."""
    batch = whole(network, scene)
    outputs = network(batch)
    if outputs.entries is None or outputs.motion.remove_logit is None:
        raise SystemExit("these weights insert or remove no agent; see --weights")
    rates = None if outputs.rates is None else outputs.rates.scaled(RATE_SCALE)
    state = _stands(batch).long()
    sums = [*_insertions(outputs, batch, state, rates)]
    sums += _removals(outputs, batch, state, rates)
    return torch.stack(sums).double().numpy()


def _stands(batch: Batch) -> Bool[Tensor, "scene token"]:
    """Tell at which token steps the ego has not moved; not at the first one."""
    pose = batch.agents.pose[:, :, EGO, :2]
    moved_m = (pose - pose.roll(1, dims=1)).norm(dim=-1)
    moved_m[:, 0] = moved_m[:, 1]
    return moved_m < DRIVING_M


def _insertions(
    outputs: Outputs, batch: Batch, state: Tensor, rates: RateProcess | None
) -> list[Tensor]:
    """Count token steps with a query, agents inserted, and those expected, by state."""
    said = outputs.entries
    assert said is not None
    pack = said.rows.pack
    turn = torch.arange(said.add_logit.shape[1])
    decided = turn <= pack(batch.entries.count)[:, None]
    expected = (_chance(said.add_logit, rates, Rate.INSERTION) * decided).sum(dim=1)
    inserted = (pack(batch.entries.add) & decided).sum(dim=1)
    each = torch.ones_like(expected), inserted, expected
    return [_by_state(values, pack(state)) for values in each]


def _removals(
    outputs: Outputs, batch: Batch, state: Tensor, rates: RateProcess | None
) -> list[Tensor]:
    """Count agents, those that are removed, and those expected to be, by state."""
    said, agents = outputs.motion, batch.agents
    pack = said.rows.pack
    mask = pack(stay_mask(agents))
    assert said.remove_logit is not None
    expected = _chance(said.remove_logit, rates, Rate.REMOVAL)
    leaves = pack(agents.presence.roll(-1, dims=1) == int(Presence.REMOVED))
    of_agent = pack(state[..., None].expand(agents.presence.shape))[mask]
    each = torch.ones_like(expected), leaves, expected
    return [_by_state(values[mask], of_agent) for values in each]


def _chance(logit: Tensor, rates: RateProcess | None, rate: Rate) -> Tensor:
    """Average probabilities over latent rates."""
    if rates is None:
        return logit.sigmoid()
    added = rates.mean[rate] + rates.scale[rate] * rates.nodes()
    weight = rates.log_prior().exp()
    found: Tensor = ((logit[..., None] + added).sigmoid() * weight).sum(dim=-1)
    return found


def _by_state(values: Tensor, state: Tensor) -> Float64[Tensor, " state"]:
    sums = torch.zeros(len(STATES), dtype=torch.float64)
    return sums.index_add(0, state, values.double())


def report(found: Float64[np.ndarray, "figure state"]) -> list[dict[str, object]]:
    """Print the table; return its rows."""
    rows: list[dict[str, object]] = []
    for at, name in enumerate(STATES):
        steps, inserted, likely, agents, removed, removable = found[:, at]
        rows.append(
            {
                "ego": name,
                "token steps": int(steps),
                "inserted": round(inserted / max(steps, 1), 3),
                "inserted, expected": round(likely / max(steps, 1), 3),
                "agents": int(agents),
                "removed": round(removed / max(agents, 1), 4),
                "removed, expected": round(removable / max(agents, 1), 4),
            }
        )
    shown = [tuple(map(str, row.values())) for row in rows]
    show_table("insertions and removals of a token step", tuple(rows[0]), shown)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Look at the logs of a root's tokens."""
    sum_over_logs(__doc__, arguments, look, report)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
