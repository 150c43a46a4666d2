"""Are motion tokens of vehicles expected, by how hard they brake or speed up?

Logs, token step by token step as they are learned from, and what some weights expect::

    python benchmarks/accelerations.py ROOT [--weights ROOT/latest/train]
        [--split validation] [--scenes 80]

The table has, by the acceleration from one half second to the next, how many motion tokens
of vehicles on the move there were, their negative log-likelihood, and by how much faster
than in the log a vehicle was expected to be. Who brakes hard and is expected not to is one
that a rollout lets run into others. The last line is one JSON object.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from logged_scenes import sum_over_logs, whole
from torch import Tensor

from infgen.clock import CLOCK
from infgen.model.batching.batch import Agents
from infgen.model.batching.supervision import following
from infgen.model.network import Network
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import SceneTokens
from pipeline.commands.screen import show_table

EDGES_MPS2 = (-3.0, -2.0, -1.0, -0.3, 0.3, 1.0)
MOVING_MPS = 1.0
"""Who is so fast, before or after a motion token, is on the move."""


def look(network: Network, scene: SceneTokens) -> Float64[np.ndarray, "3 bin"]:
    """Count motion tokens of a log; sum their nats, and speeds beyond the log's."""
    batch = whole(network, scene)
    with torch.no_grad():
        motion = network(batch).motion
    agents, rows = batch.agents, motion.rows
    mps2, counted = accelerations(agents)
    vocabulary = network.motion_vocabulary()
    counted &= (agents.motion_token >= 0) & (
        agents.motion_token < vocabulary.num_motion_tokens
    )
    mask = rows.pack(following(counted, False))
    token = rows.pack(following(agents.motion_token, 0))[mask]
    likely = motion.motion_logits[mask].log_softmax(dim=-1)
    ahead_m = torch.from_numpy(vocabulary.end_pose[AgentType.VEHICLE, :, 0])
    expected_mps = likely.exp() @ ahead_m / CLOCK.token_s
    each = torch.stack(
        [
            torch.ones_like(expected_mps),
            -likely.gather(1, token[:, None])[:, 0],
            expected_mps - ahead_m[token] / CLOCK.token_s,
        ]
    )
    group = torch.bucketize(rows.pack(following(mps2, 0))[mask], torch.tensor(EDGES_MPS2))
    found = torch.zeros((3, len(EDGES_MPS2) + 1), dtype=torch.float64)
    return found.index_add_(1, group, each.double()).numpy()


def accelerations(
    agents: Agents,
) -> tuple[Float32[Tensor, "scene token agent"], Bool[Tensor, "scene token agent"]]:
    """Accelerations to token steps from those before, and of whom they are counted."""
    pose_m = agents.pose[..., :2]
    speed_mps = torch.zeros_like(agents.pose[..., 0])
    speed_mps[:, 1:] = (pose_m[:, 1:] - pose_m[:, :-1]).norm(dim=-1) / CLOCK.token_s
    before_mps = speed_mps.roll(1, dims=1)
    seen = agents.observed & agents.visible
    counted = seen & seen.roll(1, dims=1) & seen.roll(2, dims=1)
    counted[:, :2] = False
    counted &= (agents.agent_type == AgentType.VEHICLE)[:, None]
    counted &= torch.maximum(speed_mps, before_mps) > MOVING_MPS
    return (speed_mps - before_mps) / CLOCK.token_s, counted


def report(found: Float64[np.ndarray, "3 bin"]) -> list[dict[str, object]]:
    """Print the table; return its rows, the last of them of all."""
    edges = [f"{edge:g}" for edge in EDGES_MPS2]
    names = [
        f"below {edges[0]}",
        *(f"{low} to {high}" for low, high in pairwise(edges)),
        f"above {edges[-1]}",
        "all",
    ]
    sums = np.column_stack([found, found.sum(axis=1)])
    some = [(name, *each) for name, each in zip(names, sums.T.tolist(), strict=True)]
    means = [(name, int(n), nats / n, mps / n) for name, n, nats, mps in some if n]
    show_table(
        "motion tokens of vehicles on the move",
        ("m/s2", "motion tokens", "nats", "expected faster, m/s"),
        [(name, n, f"{nats:.3f}", f"{mps:+.3f}") for name, n, nats, mps in means],
    )
    keys = ("acceleration_mps2", "motion_tokens", "nats", "faster_mps")
    rows: list[dict[str, object]] = [dict(zip(keys, mean, strict=True)) for mean in means]
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Look at the logs of a root's tokens."""
    sum_over_logs(__doc__, arguments, look, report)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
