"""Do insertions and removals keep as many agents as there are in logs?

Logs are simulated with the insertions and removals of some weights, while agents of the log
move as they did, as in closed loop of insertion and removal. So it shows what these two
make of the number of agents, whatever agents do, in a few seconds a log::

    python benchmarks/simulated_counts.py ROOT [--weights ROOT/latest/train]
        [--split validation] [--scenes 80]

The table has, for each quarter of the logs, means over its token steps: agents within the
radius of the grid around the ego, and beyond it; agents inserted and removed; in logs and
simulated. Agents are inserted as the weights sample them, and latent rates vary as in
rollouts, half as much as was learned. The last line is one JSON object.
"""

from collections.abc import Sequence
from functools import partial
from itertools import count

import numpy as np
import torch
from ego_standing import RATE_SCALE
from jaxtyping import Float64
from logged_scenes import sum_over_logs, whole
from torch import Tensor

from infgen.model.batching.batch import Agents
from infgen.model.network import Network
from infgen.model.relations import within_radius
from infgen.model.training.closed_loop_population import close_population_loop
from infgen.tokens.scene_tokens import EGO, Presence, SceneTokens
from pipeline.commands.screen import show_table

QUARTERS = 4
FIGURES = ("agents within the radius", "agents beyond it", "inserted", "removed")
OWN_SHARE = 1.0
"""Share of insertions as the weights sample them (``train.own_insertion_share``)."""


def look(
    seeds: "count[int]", network: Network, scene: SceneTokens
) -> Float64[np.ndarray, "figure source quarter"]:
    """Sum up ``FIGURES`` and count their token steps, in the log and as simulated."""
    logged = whole(network, scene)
    if network.cells is None:
        raise SystemExit("these weights insert and remove no agent; see --weights")
    network.eval()
    simulated = close_population_loop(
        network, logged, 0, next(seeds), RATE_SCALE, own_share=OWN_SHARE
    )
    radius_m = network.grid.radius_m
    found = [figures(batch.agents, radius_m) for batch in (logged, simulated)]
    return torch.stack(found, dim=1).numpy()


def figures(agents: Agents, radius_m: float) -> Float64[Tensor, "figure quarter"]:
    """Sum up ``FIGURES`` over the token steps of each quarter of a scene; count these.

    Without the first one, at which all agents are inserted in logs and in simulation.
    """
    presence, pose = agents.presence[0, 1:], agents.pose[0, 1:]
    stays = agents.visible[0, 1:] & (presence != int(Presence.REMOVED))
    near = within_radius(pose[:, EGO, None].expand_as(pose), pose, radius_m)
    each = (
        stays & near,
        stays & ~near,
        presence == int(Presence.INSERTED),
        presence == int(Presence.REMOVED),
    )
    tokens = len(presence)
    quarter = torch.arange(tokens) * QUARTERS // tokens
    sums = torch.stack([*(who.sum(dim=1) for who in each), torch.ones(tokens)]).double()
    return sums.new_zeros((len(sums), QUARTERS)).index_add(1, quarter, sums)


def report(
    found: Float64[np.ndarray, "figure source quarter"],
) -> list[dict[str, object]]:
    """Print the table; return its rows."""
    rows: list[dict[str, object]] = []
    for name, sums in zip(FIGURES, found[:-1] / found[-1].clip(min=1), strict=True):
        for source, values in zip(("logs", "simulated"), sums, strict=True):
            means = {f"quarter {at + 1}": round(v, 2) for at, v in enumerate(values)}
            rows.append({"mean of a token step": name, "in": source, **means})
    shown = [tuple(map(str, row.values())) for row in rows]
    show_table("agents in logs, and with insertions and removals", tuple(rows[0]), shown)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate the logs of a root's tokens."""
    sum_over_logs(__doc__, arguments, partial(look, count()), report)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
