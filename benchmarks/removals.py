"""Are those removed who leave in logs: vehicles that drive, that stand, and newly inserted?

Logs, token step by token step as they are learned from, and what some weights expect::

    python benchmarks/removals.py ROOT [--weights ROOT/latest/train]
        [--split validation] [--scenes 80]

The table has, by what vehicles do and by their distance to the ego, how many token steps
there were, the share at whose end the vehicle left the scene, and the share that was
expected. A network that is right in sum may still remove too many that drive close to the
ego. The last line is one JSON object.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float64
from logged_scenes import sum_over_logs, whole
from torch import Tensor

from infgen.model.batching.batch import Agents
from infgen.model.batching.supervision import stay_mask
from infgen.model.network import Network
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import Presence, SceneTokens
from pipeline.commands.screen import show_table

DRIVING_M = 0.25
"""Who moves so far in half a second drives."""
RING_EDGES_M = (0.0, 30.0, 55.0, 72.0, float("inf"))
"""Distances to the ego. Agents leave mostly at the edge of what is tokenized (75 m)."""
STATES = ("drives", "stands", "just inserted")


def look(network: Network, scene: SceneTokens) -> Float64[np.ndarray, "3 state ring"]:
    """Count token steps of vehicles in a log, removals expected, and removals logged."""
    batch = whole(network, scene)
    with torch.no_grad():
        motion = network(batch).motion
    if motion.remove_logit is None:
        raise SystemExit("these weights never remove an agent; see --weights")
    agents, rows = batch.agents, motion.rows
    counted = stay_mask(agents) & (agents.agent_type == AgentType.VEHICLE)[:, None]
    leaves = agents.presence.roll(-1, dims=1) == int(Presence.REMOVED)
    away_m = (agents.pose[..., :2] - agents.pose[:, :, :1, :2]).norm(dim=-1)
    ring = torch.bucketize(away_m, torch.tensor(RING_EDGES_M[1:-1]), right=True)
    group = rows.pack(_state(agents) * (len(RING_EDGES_M) - 1) + ring)
    odds = motion.remove_logit.sigmoid()
    each = torch.stack([torch.ones_like(odds), odds, rows.pack(leaves).float()])
    mask = rows.pack(counted)
    found = torch.zeros((3, len(STATES) * (len(RING_EDGES_M) - 1)), dtype=torch.float64)
    found.index_add_(1, group[mask], each[:, mask].double())
    return found.view(3, len(STATES), -1).numpy()


def _state(agents: Agents) -> Tensor:
    """Which of ``STATES`` agents are in [scene, token, agent]."""
    before = agents.pose.roll(1, dims=1)
    moved: Bool[Tensor, "scene token agent"]
    moved = (agents.pose - before)[..., :2].norm(dim=-1) > DRIVING_M
    state = torch.where(moved, STATES.index("drives"), STATES.index("stands"))
    inserted = agents.presence == int(Presence.INSERTED)
    return torch.where(inserted, STATES.index("just inserted"), state)


def report(found: Float64[np.ndarray, "3 state ring"]) -> list[dict[str, object]]:
    """Print the table; return its rows."""
    rows: list[dict[str, object]] = []
    for at, name in enumerate(STATES):
        for ring, (count, expected, logged) in enumerate(found[:, at].T):
            if count:
                least, most = RING_EDGES_M[ring : ring + 2]
                rows.append(
                    {
                        "vehicle": name,
                        "away_m": f"{least:.0f} to {most:.0f}"
                        if most < np.inf
                        else "beyond",
                        "token_steps": int(count),
                        "removed": round(logged / count, 4),
                        "expected": round(expected / count, 4),
                    }
                )
    show_table(
        "vehicles removed at the end of a token step",
        ("vehicle", "m to the ego", "token steps", "logs", "expected"),
        [
            (
                r["vehicle"],
                r["away_m"],
                r["token_steps"],
                f"{r['removed']:.2%}",
                f"{r['expected']:.2%}",
            )
            for r in rows
        ],
    )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Look at the logs of a root's tokens."""
    sum_over_logs(__doc__, arguments, look, report)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
