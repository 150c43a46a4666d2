"""How the agents of a batch have moved in the last token step."""

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from infgen.model.batching.batch import Agents
from infgen.tokens.scene_tokens import Presence


def poses_before(
    agents: Agents,
) -> tuple[Float32[Tensor, "scene token agent 3"], Bool[Tensor, "scene token agent"]]:
    """Poses one token step earlier, and whether agents were seen there."""
    pose, visible = agents.pose, agents.visible
    known = torch.zeros_like(visible)
    known[:, 1:] = visible[:, :-1]
    return torch.cat([pose[:, :1], pose[:, :-1]], dim=1), known


def steps_m(agents: Agents) -> Float32[Tensor, "scene token agent 2"]:
    """Displacements in the last token step; zero where they are not known."""
    before, known = poses_before(agents)
    known = known & (agents.presence != int(Presence.INSERTED))
    return (agents.pose - before)[..., :2] * known[..., None]
