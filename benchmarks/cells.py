"""Are agents inserted where logs insert them, as far as weights tell from the log's states?

Logs, token step by token step as they are learned from, and what some weights expect::

    python benchmarks/cells.py ROOT [--weights ROOT/latest/train]
        [--split validation] [--scenes 80]

For every agent that a log inserts: the nats of its cell, and the entropy of the
distribution (larger than the nats: less sure than it might be; smaller: too sure); what
share of the distribution, and of logs, is on cells that hold an agent already, and on cells
whose centre is off the road; and what share of agents is of each type in logs, as expected
at the cells of the logs, and as expected at cells that are sampled instead. The last line
is one JSON object.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from logged_scenes import sum_over_logs, whole
from torch import Tensor

from infgen.model.agent_embedding import KINDS
from infgen.model.batching.batch import Batch
from infgen.model.network import Network
from infgen.model.training.policy_gradient.road import read_roads
from infgen.tokens.grid import from_grid
from infgen.tokens.scene_tokens import EGO, SceneTokens
from pipeline.commands.screen import show_table

FIGURES = (
    *("agents", "nats", "entropy", "held", "held_logged"),
    *("off_road", "off_road_logged"),
)
SEED = 0


def look(
    random: torch.Generator, network: Network, scene: SceneTokens
) -> Float64[np.ndarray, " sum"]:
    """Sum up ``FIGURES``, then types: logged, at logged cells, at sampled cells."""
    batch = whole(network, scene)
    details = batch.details
    rollout, place = (details.present & details.inserted).nonzero(as_tuple=True)
    token, turn = details.token[rollout, place], details.turn[rollout, place]
    cell = details.cell[rollout, place]
    with torch.no_grad():
        entries = network(batch).entries
        if entries is None or entries.position_logits is None:
            raise SystemExit("these weights do not sample cells; see --weights")
        row = entries.rows.number[rollout, token]
        likely = entries.position_logits[row, turn].log_softmax(dim=1)
        sampled = details.cell.clone()
        if len(cell):
            drawn = torch.multinomial(likely.exp(), 1, generator=random)
            sampled[rollout, place] = drawn[:, 0]
        elsewhere = replace(batch, details=replace(details, cell=sampled))
        types = [
            _types(network, each, rollout, place).sum(dim=0) for each in (batch, elsewhere)
        ]
    held = _held(batch, rollout, token, likely.shape[1])
    off_road = _off_road(network, batch, token, likely.shape[1])
    each = torch.arange(len(cell))
    found = [
        len(cell),
        -likely[each, cell].sum(),
        -(likely.exp() * likely).sum(),
        likely.exp()[held].sum(),
        held[each, cell].sum(),
        likely.exp()[off_road].sum(),
        off_road[each, cell].sum(),
    ]
    logged = details.agent_type[rollout, place].bincount(minlength=len(KINDS))
    return np.array([*map(float, found), *logged.tolist(), *torch.cat(types).tolist()])


def _types(
    network: Network, batch: Batch, rollout: Tensor, place: Tensor
) -> Float32[Tensor, "agent agent_type"]:
    """Return how likely the types of inserted agents are at their cells."""
    details = network(batch).details
    assert details is not None
    row = details.rows.number[rollout, place]
    likely: Tensor = details.agent_type_logits[row].softmax(dim=1)
    return likely


def _held(
    batch: Batch, rollout: Int64[Tensor, " agent"], token: Tensor, cells: int
) -> Tensor:
    """Mark the cells [agent, cell] that hold an agent before anyone is inserted."""
    agents = batch.agents
    there = agents.visible[rollout, token] & (agents.turn[rollout, token] < 0)
    cell = agents.cell[rollout, token]
    cell = torch.where(there & (cell >= 0), cell, cells)
    held = torch.zeros((len(cell), cells + 1), dtype=torch.bool)
    return held.scatter(1, cell, True)[:, :-1]


def _off_road(
    network: Network, batch: Batch, token: Int64[Tensor, " agent"], cells: int
) -> Bool[Tensor, "agent cell"]:
    """Mark the cells whose centre is off the road, where the ego is then."""
    (road,) = read_roads(batch.roads, network.map_vocabulary())
    tokens, place = np.unique(token.numpy(), return_inverse=True)
    ego_pose = batch.agents.pose[0, tokens, EGO].numpy().repeat(cells, axis=0)
    centre_m = np.tile(network.grid.centre_m[:cells], (len(tokens), 1))
    point = np.column_stack([from_grid(centre_m, ego_pose), 0 * centre_m[:, 0]])
    no_size_m = np.zeros((len(point), 2), dtype=np.float32)
    off_m = road.off_m(point.astype(np.float32), no_size_m)
    return torch.from_numpy(off_m > 0).view(len(tokens), cells)[place]


def report(found: Float64[np.ndarray, " sum"]) -> list[dict[str, object]]:
    """Print both tables; return their rows."""
    agents, nats, entropy, *shares = found[: len(FIGURES)]
    count = max(1.0, agents)
    figures: dict[str, object] = {
        "agents": int(agents),
        "nats": round(nats / count, 3),
        "entropy": round(entropy / count, 3),
        **{
            name: round(share / count, 4)
            for name, share in zip(FIGURES[3:], shares, strict=True)
        },
    }
    of_types = found[len(FIGURES) :].reshape(3, -1) / count
    types: list[dict[str, object]] = [
        {"types": name, **{x.name.lower(): round(share[x], 4) for x in KINDS}}
        for name, share in zip(("logged", "at_logged", "at_sampled"), of_types, strict=True)
    ]
    for title, rows in (("cells of inserted agents", [figures]), ("their types", types)):
        head = tuple(name.replace("_", " ") for name in rows[0])
        show_table(title, head, [tuple(map(str, row.values())) for row in rows])
    return [figures, *types]


def main(arguments: Sequence[str] | None = None) -> None:
    """Look at the logs of a root's tokens."""
    random = torch.Generator().manual_seed(SEED)
    sum_over_logs(__doc__, arguments, partial(look, random), report)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
