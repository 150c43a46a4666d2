"""Closed-loop fine-tuning: scenes simulated by the network itself, to learn from (CatK).

CatK (SPEC 7.1): at every token step each agent takes, of the motion tokens that the network
finds most likely, the one that ends nearest to where the log says the agent is. So the
scene stays near the log, and all that is seen of it is the network's own doing. What is to
be learned is the motion token of all that leads nearest to the log from where the agent has
come to. Both may lead only a part of the way back (``recovery``): an agent that has fallen
behind the log and catches up at once drives at speeds that no log has.

Where the log says an agent is means its quantised pose, as batches hold it.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from infgen.model.batching.batch import Agents, Batch, Details, Insertions
from infgen.model.batching.frames import to_local, to_world
from infgen.model.batching.insertion_targets import describe
from infgen.model.batching.recovery import WHOLE_RECOVERY, Recovery
from infgen.model.network import Network
from infgen.model.stepping import Stepper
from infgen.model.token_step import TokenStep
from infgen.model.training.nearest_tokens import (
    MotionTokenEnds,
    nearest,
    nearest_of,
)
from infgen.tokens.grid import Grid, encode_cell, to_grid
from infgen.tokens.scene_tokens import EGO, NO_CELL, Presence


@torch.no_grad()
def close_loop(
    network: Network, batch: Batch, top: int, recovery: Recovery = WHOLE_RECOVERY
) -> Batch:
    """Simulate a batch from its first token step on, close to the log.

    Insertions, removals and gaps are those of the log: inserted agents start at their true
    poses, and agents seen again after a gap go on from theirs. Cells, headings and
    offsets relative to the ego are computed anew, as it is simulated like all
    others.

    Args:
        network: The network; its mode (training or not) is kept.
        batch: Scenes as logged, without noise, on the network's device.
        top: Most likely motion tokens that each is chosen from.
        recovery: How much of a deviation is made good in a token step.

    Returns:
        The batch to learn from, with other poses, moves, labels and cells.

    Raises:
        ValueError: if there is nothing to choose from.
    """
    if top < 1:
        raise ValueError(
            f"no motion_token is among the {top} most likely moves; expected 1 or more"
        )
    learning = network.training
    try:
        agents, off = _play(network, batch, top, recovery)
    finally:
        network.train(learning)
    return replace(
        batch,
        agents=agents,
        entries=_tell_entries(batch.entries, agents),
        details=_tell_details(batch.details, agents, off, network.grid),
    )


def _play(
    network: Network, batch: Batch, top: int, recovery: Recovery
) -> tuple[Agents, Tensor]:
    """Simulate all agents; also mark where [scene, token, agent] they are not as logged."""
    logged, stepper, grid = batch.agents, Stepper(network), network.grid
    device = logged.pose.device
    vocabulary = network.motion_vocabulary()
    ends, top = (
        MotionTokenEnds.of(vocabulary, device),
        min(top, vocabulary.num_motion_tokens),
    )
    scenes, tokens, rows = logged.motion_token.shape
    memory = stepper.begin(batch.roads, torch.arange(scenes, device=device), rows)
    off = torch.zeros_like(logged.observed)
    played = replace(
        logged,
        pose=logged.pose.clone(),
        motion_token=logged.motion_token.clone(),
        label=logged.label.clone(),
        cell=logged.cell.clone(),
    )
    for token in range(1, tokens):
        said = stepper.motion_step(memory, token_step_at(played, token - 1))
        who = logged.observed[:, token] & logged.visible[:, token - 1]
        choice = said.motion_logits, top, ends, recovery
        move_near_log(played, logged, off, token, who, *choice)
        played.cell[:, token] = _cells(played, logged, off, token, grid)
    return played, off


def move_near_log(
    played: Agents,
    logged: Agents,
    off: Tensor,
    token: int,
    who: Tensor,
    logits: Tensor,
    top: int,
    ends: MotionTokenEnds,
    recovery: Recovery,
) -> None:
    """Write the next motion tokens of some agents, and where these lead.

    Args:
        played: All agents as simulated so far; changed in place.
        logged: The same agents as logged.
        off: Whether they are not as logged [scene, token, agent]; changed in place.
        token: The next token step.
        who: Agents that are seen at both token steps [scene, agent].
        logits: Of their motion tokens [scene, agent, motion_token].
        top: Most likely motion tokens that each is chosen from.
        ends: Where motion tokens end.
        recovery: How much of a deviation is made good in a token step.
    """
    take, write = _rows_of(who)
    before, true = take(played.pose[:, token - 1]), take(logged.pose[:, token])
    agent_type = take(logged.agent_type)
    # After a gap in its log an agent is to be where the log has it.
    was_seen = take(logged.observed[:, token - 1])[:, None]
    was = torch.where(was_seen, take(logged.pose[:, token - 1]), before)
    wanted = to_local(recovery.target(before, was, true), before)
    likely = take(logits).topk(top).indices.sort().values
    taken = nearest_of(wanted, agent_type, likely, ends)

    # Agents at their logged poses with logged tokens keep these bit for bit.
    strays = take(off[:, token - 1]) | (taken != take(logged.motion_token[:, token]))
    led = to_world(ends.pose[agent_type, taken], before)
    write(off[:, token], strays)
    write(played.motion_token[:, token], taken)
    write(played.label[:, token], nearest(wanted, agent_type, ends))
    write(played.pose[:, token], torch.where(strays[:, None], led, true))


def _rows_of(
    who: Tensor,
) -> tuple[Callable[[Tensor], Tensor], Callable[[Tensor, Tensor], None]]:
    """How rows of [scene, agent] are taken, and written to the places that a mask names.

    A CPU takes those rows alone; elsewhere the host would wait to know them, so there all
    are taken.
    """

    def write(values: Tensor, rows: Tensor) -> None:
        if who.device.type == "cpu":
            values[who] = rows
            return
        mask = who if values.dim() == who.dim() else who[..., None]
        values.copy_(torch.where(mask, rows.view_as(values), values))

    if who.device.type == "cpu":
        return lambda values: values[who], write
    return lambda values: values.flatten(0, 1), write


def token_step_at(agents: Agents, token: int) -> TokenStep:
    """Take the agents of one token step of a batch."""
    return TokenStep(
        agent_type=agents.agent_type,
        size_lwh_m=agents.size_lwh_m,
        pose=agents.pose[:, token],
        motion_token=agents.motion_token[:, token],
        presence=agents.presence[:, token],
        observed=agents.observed[:, token],
        cell=agents.cell[:, token],
    )


def _cells(played: Agents, logged: Agents, off: Tensor, token: int, grid: Grid) -> Tensor:
    """Cells [scene, agent] in the grid of the simulated ego; insertions keep theirs."""
    pose, old = played.pose[:, token].numpy(force=True), logged.cell[:, token]
    found = encode_cell(to_grid(pose[..., :2], pose[:, EGO, None]), grid)
    new = torch.from_numpy(found).to(old)
    entering = logged.presence[:, token] == int(Presence.INSERTED)
    lost = entering & ((old == NO_CELL) | (new == NO_CELL))
    told = logged.visible[:, token] & (off[:, token] | off[:, token, EGO, None])
    return torch.where(told & ~lost, new, old)


def _tell_entries(entries: Insertions, agents: Agents) -> Insertions:
    cell = agents.cell.gather(2, entries.agent.clamp(min=0))
    return replace(entries, cell=torch.where(entries.agent >= 0, cell, entries.cell))


def _tell_details(details: Details, agents: Agents, off: Tensor, grid: Grid) -> Details:
    """Describe the agents that are not to the ego as they were."""
    scene = torch.arange(len(off), device=off.device)[:, None]
    token, agent = details.token, details.agent.clamp(min=0)
    changed = off[scene, token, agent] | off[scene, token, EGO]
    changed &= details.present
    new = agents.cell[scene, token, agent]
    cell = torch.where(changed & (new != NO_CELL), new, details.cell)
    pose, ego_pose = agents.pose[scene, token, agent], agents.pose[scene, token, EGO]
    told = describe(
        pose.numpy(force=True), ego_pose.numpy(force=True), cell.numpy(force=True), grid
    )
    heading, offset = torch.from_numpy(np.stack(told[::2])).to(cell)
    offset_m = torch.from_numpy(told[1]).to(pose)
    return replace(
        details,
        cell=cell,
        heading=torch.where(changed, heading, details.heading),
        offset_m=torch.where(changed[..., None], offset_m, details.offset_m),
        offset=torch.where(changed, offset, details.offset),
    )
