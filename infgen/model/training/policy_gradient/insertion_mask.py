"""The insertion mask of rollouts that are learned from: boxes of other agents.

As in rollouts (``infgen.rollout.rules.insertion_mask``), but for the distance to a lane: a
position is free if the box overlaps no other one, neither now nor after one more token step
of constant motion. Pedestrians may overlap pedestrians.
"""

from collections.abc import Callable
from dataclasses import fields

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from infgen.geometry import boxes_overlap, to_world
from infgen.model.batching.batch import Agents
from infgen.model.step_memory import Insertions
from infgen.model.stepping import Stepper
from infgen.model.token_step import PositionOutputs
from infgen.model.training.own_choices import InsertedAgent, UniformNumbers, sample_agent
from infgen.scene import AgentType
from infgen.tokens.grid import Grid
from infgen.tokens.scene_tokens import Presence

ATTEMPTS = 16
"""Position tokens that are sampled for one agent, as with ``rollout.rules=safe``."""

IsFree = Callable[[InsertedAgent, Tensor], Tensor]
"""Tell of agents which are at a free position, given their places among those asked."""


def sample_free_agent(
    stepper: Stepper,
    entries: Insertions,
    query: PositionOutputs,
    uniforms: UniformNumbers,
    grid: Grid,
    is_free: IsFree,
) -> tuple[InsertedAgent, Bool[Tensor, " rollout"]]:
    """Sample an agent per rollout, again in other cells where its position is not free.

    Returns:
        The agents, and which of them are at a free position.
    """
    everyone = torch.arange(len(query.add_logit), device=query.add_logit.device)
    found = sample_agent(stepper, entries, query, uniforms, grid)
    free = is_free(found, everyone)
    if query.position_logits is None:  # The position is regressed: it would be the same.
        return found, free
    logits = query.position_logits.clone()
    for _ in range(ATTEMPTS - 1):
        again = everyone[~free]
        if not len(again):
            break
        logits[again, found.cell[again]] = -torch.inf
        others = PositionOutputs(query.add_logit[again], logits[again], None)
        agent = sample_agent(stepper, entries.take(again), others, uniforms, grid)
        for each in fields(InsertedAgent):
            getattr(found, each.name)[again] = getattr(agent, each.name)
        free[again] = is_free(agent, again)
    return found, free


def find_free(
    agents: Agents,
    token: int,
    scene: Tensor,
    inserted: InsertedAgent,
    end_pose: Float32[np.ndarray, "3 motion_token 3"],
) -> Bool[Tensor, " inserted"]:
    """Tell which inserted agents overlap no agent of their scene, now and a step later.

    Args:
        agents: All agents of all scenes.
        token: Token step.
        scene: Where each agent is inserted.
        inserted: Agents to insert.
        end_pose: End pose of each motion token by agent type.
    """
    at = scene.numpy(force=True)
    presence, now, motion_token = (
        each[:, token].numpy(force=True)[at]
        for each in (agents.presence, agents.pose, agents.motion_token)
    )
    agent_type, size_lwh_m = (
        each.numpy(force=True)[at] for each in (agents.agent_type, agents.size_lwh_m)
    )
    own_type = inserted.agent_type.numpy(force=True)
    walks = (agent_type == AgentType.PEDESTRIAN) & (own_type == AgentType.PEDESTRIAN)[
        :, None
    ]
    who, row = np.nonzero((presence != Presence.ABSENT) & ~walks)
    now, agent_type, move = (x[who, row] for x in (now, agent_type, motion_token))
    step = end_pose[agent_type, np.maximum(move, 0)] * (move >= 0)[:, None]
    meets = boxes_overlap(
        inserted.pose.numpy(force=True)[who],
        inserted.size_lwh_m.numpy(force=True)[who, :2],
        np.stack([now, to_world(step, now)]),
        size_lwh_m[who, row, :2],
    ).any(axis=0)
    free = np.ones(len(at), dtype=bool)
    free[who[meets]] = False
    return torch.from_numpy(free).to(scene.device)
