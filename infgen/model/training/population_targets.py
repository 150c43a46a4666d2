"""What is to be learned from scenes in which the network inserts and removes agents."""

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from infgen.model.batching.batch import Agents, Batch, Details, Insertions
from infgen.model.batching.insertion_targets import describe
from infgen.model.batching.padding import NO_AGENT
from infgen.tokens.grid import Grid
from infgen.tokens.scene_tokens import EGO, NO_CELL, Presence


@dataclass(slots=True)
class InsertionTurns:
    """What is learned at the insertion turns.

    Attributes:
        count: Agents that were inserted and were to be [scene, token]: one turn more is
            learned. Those after it would teach how often so many more are inserted, where
            the network is to know it of the steps that insert so many at all.
        add: Whether an agent is to be inserted at each turn [scene, token, slot].
        agent: That agent, if it is fresh, or ``NO_AGENT`` [scene, token, slot].
    """

    count: Tensor
    add: Tensor
    agent: Tensor

    @classmethod
    def none(
        cls, scenes: int, tokens: int, slots: int, device: torch.device
    ) -> "InsertionTurns":
        """Return no insertions, and none to learn."""
        agent = torch.full((scenes, tokens, slots), NO_AGENT, device=device)
        add = torch.zeros_like(agent, dtype=torch.bool)
        return cls(torch.zeros_like(agent[..., 0]), add, agent)


def targets(
    batch: Batch, logged: Agents, played: Agents, turns: InsertionTurns, grid: Grid
) -> Batch:
    """Return the batch to learn from.

    Args:
        batch: The scenes as logged.
        logged: Their agents, followed by free rows.
        played: The same agents as they were simulated.
        turns: Insertions.
        grid: Cells and heading bins.
    """
    entries = insertions_of(turns, batch.entries.asked, played)
    pseudo = _pseudo(batch.details, logged, played)
    details = describe_details(
        _join(pseudo, inserted_details(entries, played)), played, grid
    )
    return replace(batch, agents=played, entries=entries, details=details)


def insertions_of(turns: InsertionTurns, asked: Tensor, played: Agents) -> Insertions:
    """Write insertion turns as a batch has them.

    Args:
        turns: Insertions.
        asked: Token steps with insertion queries [scene, token].
        played: Agents as they were simulated.
    """
    used = int(turns.count.max()) + 1
    agent = turns.agent[..., :used]
    cell = played.cell.gather(2, agent.clamp(min=0))
    return Insertions(
        asked=asked,
        count=turns.count,
        add=turns.add[..., :used],
        agent=agent,
        cell=torch.where(agent >= 0, cell, 0),
    )


def _pseudo(details: Details, logged: Agents, played: Agents) -> Details:
    """Agents that play the part of inserted ones, where they are still there."""
    scene = torch.arange(len(details.agent), device=details.agent.device)[:, None]
    here = scene, details.token, details.agent.clamp(min=0)
    there = details.present & ~details.inserted & played.observed[here]
    cell = played.cell[here]
    there &= (cell != NO_CELL) & (logged.presence[here] != int(Presence.ABSENT))
    return replace(details, present=there, cell=torch.where(there, cell, 0))


def inserted_details(entries: Insertions, played: Agents) -> Details:
    """Take the inserted agents of all turns; headings and offsets are still to be told."""
    scenes, tokens, slots = entries.agent.shape
    agent, device = entries.agent.flatten(1), entries.agent.device
    own, row = agent >= 0, agent.clamp(min=0)
    scene = torch.arange(scenes, device=device)[:, None]
    token = torch.arange(tokens, device=device).repeat_interleave(slots)
    return Details(
        present=own,
        inserted=own,
        agent=row,
        token=token.expand(scenes, -1),
        turn=torch.arange(slots, device=device).repeat(tokens).expand(scenes, -1),
        cell=entries.cell.flatten(1),
        agent_type=played.agent_type[scene, row],
        size_lwh_m=played.size_lwh_m[scene, row],
        heading=torch.zeros_like(agent),
        offset_m=played.pose.new_zeros((*agent.shape, 2)),
        offset=torch.zeros_like(agent),
    )


def _join(one: Details, other: Details) -> Details:
    """Put details side by side."""
    parts = {
        each.name: torch.cat([getattr(one, each.name), getattr(other, each.name)], dim=1)
        for each in fields(one)
    }
    return Details(**parts)


def describe_details(details: Details, agents: Agents, grid: Grid) -> Details:
    """Tell headings and offsets within cells of all who are described."""
    scene = torch.arange(len(details.agent), device=details.agent.device)[:, None]
    pose = agents.pose[scene, details.token, details.agent]
    ego_pose = agents.pose[scene, details.token, EGO]
    told = describe(
        pose.numpy(force=True),
        ego_pose.numpy(force=True),
        details.cell.numpy(force=True),
        grid,
    )
    heading, offset = torch.from_numpy(np.stack(told[::2])).to(details.heading)
    offset_m = torch.from_numpy(told[1]).to(details.offset_m)
    return replace(
        details,
        heading=torch.where(details.present, heading, 0),
        offset_m=torch.where(details.present[..., None], offset_m, 0),
        offset=torch.where(details.present, offset, 0),
    )
