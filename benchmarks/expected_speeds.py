"""Do vehicles keep the speeds of logs? The next speed that is expected, by the one now.

Logs, token step by token step as they are learned from, and what some weights expect::

    python benchmarks/expected_speeds.py ROOT [--weights ROOT/latest/train]
        [--split validation] [--scenes 80]

The table has, for the ego and for other vehicles, by how fast they are, the mean speed of a
token step, of the next one in the log, and of the next one that is expected; then the
spread that is expected around that, and the error, both as roots of mean squares: alike if
the distribution is as wide as it should be. A network that is right in the mean may still
expect fast vehicles to brake; then rollouts, of many such steps, are slow. The last line is
one JSON object.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float64
from logged_scenes import sum_over_logs, whole
from torch import Tensor

from infgen.clock import CLOCK
from infgen.model.batching.supervision import following, motion_mask
from infgen.model.network import Network
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import EGO, SceneTokens
from pipeline.commands.screen import show_table

SPEED_EDGES_MPS = (0.5, 2.5, 5.0, 8.0, 11.0, 14.0)
WHO = ("other vehicles", "the ego")
MEANS = ("now", "next in the log", "expected")
ROOTS = ("spread expected", "error")
COLUMNS = MEANS + ROOTS


def look(network: Network, scene: SceneTokens) -> Float64[np.ndarray, "6 who bin"]:
    """Count token steps of vehicles in a log, and sum up what ``COLUMNS`` are made of."""
    batch = whole(network, scene)
    with torch.no_grad():
        motion = network(batch).motion
    agents, rows = batch.agents, motion.rows
    counted = motion_mask(agents) & (agents.agent_type == AgentType.VEHICLE)[:, None]
    end_pose = network.motion_vocabulary().end_pose[AgentType.VEHICLE]
    speed_mps = _speed_mps(torch.from_numpy(end_pose))
    now, then = rows.pack(agents.motion_token), rows.pack(following(agents.label, -1))
    # Special tokens, as of agents that have just been inserted, have no speed.
    known = [(each >= 0) & (each < len(speed_mps)) for each in (now, then)]
    mask = rows.pack(counted) & known[0] & known[1]
    likely = motion.motion_logits[mask].double().softmax(dim=1)
    logged_mps, expected_mps = speed_mps[then[mask]], likely @ speed_mps
    each = torch.stack(
        [
            torch.ones(len(likely), dtype=torch.float64),
            speed_mps[now[mask]],
            logged_mps,
            expected_mps,
            likely @ speed_mps.square() - expected_mps.square(),
            (logged_mps - expected_mps).square(),
        ]
    )
    edges_mps = torch.tensor(SPEED_EDGES_MPS, dtype=torch.float64)
    ego = (rows.at % agents.visible.shape[2] == EGO)[mask].long()
    group = ego * (len(edges_mps) + 1) + torch.bucketize(each[1], edges_mps, right=True)
    found = each.new_zeros((len(each), len(WHO) * (len(edges_mps) + 1)))
    return found.index_add_(1, group, each).view(len(each), len(WHO), -1).numpy()


def _speed_mps(end_pose: Tensor) -> Float64[Tensor, " motion_token"]:
    """Mean speed of motion tokens, by where they end; backwards is below zero."""
    end = end_pose.double()
    return end[:, :2].norm(dim=1) * end[:, 0].sign() / CLOCK.token_s


def report(found: Float64[np.ndarray, "6 who bin"]) -> list[dict[str, object]]:
    """Print the table; return its rows."""
    rows: list[dict[str, object]] = []
    bounds = [f"{low:g} to {high:g}" for low, high in pairwise(SPEED_EDGES_MPS)]
    names = [f"below {SPEED_EDGES_MPS[0]:g}", *bounds, f"{SPEED_EDGES_MPS[-1]:g} and more"]
    for who, sums in zip(WHO, found.swapaxes(0, 1), strict=True):
        for name, (count, *added) in zip(names, sums.T, strict=True):
            means = np.array(added) / max(1.0, count)
            means[len(MEANS) :] **= 0.5
            told = {"who": who, "m/s": name, "token steps": int(count)}
            values = zip(COLUMNS, means.round(3).tolist(), strict=True)
            rows.append({**told, **dict(values)})
    show_table(
        "speeds of vehicles, m/s",
        tuple(rows[0]),
        [tuple(map(str, row.values())) for row in rows],
    )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Look at the logs of a root's tokens."""
    sum_over_logs(__doc__, arguments, look, report)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
