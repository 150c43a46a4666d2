"""What a network chooses while scenes are simulated to be learned from."""

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from infgen.model.insertion.detail_query import InsertionDetails
from infgen.model.neighbours import cell_pose
from infgen.model.relations import wrap_angle
from infgen.model.sampling import choose
from infgen.model.step_memory import Insertions
from infgen.model.stepping import Stepper
from infgen.model.token_step import PositionOutputs
from infgen.tokens.grid import Grid, encode_cell
from infgen.tokens.scene_tokens import EGO

INSIDE = 0.999
"""Inserted agents stay within this share of the grid radius, whatever their offsets."""


@dataclass(slots=True)
class UniformNumbers:
    """Uniform numbers in [0, 1), drawn on the CPU: the same for every device.

    Attributes:
        seed: Of all of them.
        device: Where they are needed.
    """

    seed: int
    device: torch.device
    generator: torch.Generator | None = None

    def draw(self, *shape: int) -> Tensor:
        """Draw the next ones (float64)."""
        if self.generator is None:
            self.generator = torch.Generator().manual_seed(self.seed)
        drawn = torch.rand(shape, generator=self.generator, dtype=torch.float64)
        return drawn.to(self.device)


@dataclass(frozen=True, slots=True)
class InsertedAgent:
    """An agent per rollout, as the network inserts it.

    Attributes:
        cell: Cell of the ego's grid [rollout].
        pose: x, y, heading in the world [rollout, 3].
        agent_type: ``AgentType`` [rollout].
        size_lwh_m: Box [rollout, 3].
    """

    cell: Tensor
    pose: Tensor
    agent_type: Tensor
    size_lwh_m: Tensor

    def take(self, rollouts: Tensor) -> "InsertedAgent":
        """Go on with some rollouts only."""
        return InsertedAgent(*(getattr(self, each.name)[rollouts] for each in fields(self)))


def sample_agent(
    stepper: Stepper,
    entries: Insertions,
    query: PositionOutputs,
    uniforms: UniformNumbers,
    grid: Grid,
) -> InsertedAgent:
    """Sample where an agent is inserted and what it is, of every rollout that goes on."""
    count = len(query.add_logit)
    if query.position_logits is not None:
        cell, regressed_m = choose(query.position_logits, uniforms.draw(count)), None
    else:
        assert query.position_m is not None
        regressed_m = _within(query.position_m, grid)
        found = torch.from_numpy(encode_cell(regressed_m.numpy(force=True), grid))
        cell = found.to(regressed_m.device).long()
    details = stepper.entry_details(entries, cell, regressed_m)
    agent_type = choose(details.agent_type_logits, uniforms.draw(count))
    each = torch.arange(count, device=cell.device)
    if details.query is None:
        offset_m = None if details.offset_m is None else details.offset_m[each, agent_type]
        turned_rad = _turned(details, each, agent_type, uniforms, grid)
    else:
        logits = details.query.offset_logits(agent_type)
        offset = choose(logits, uniforms.draw(count))
        offset_m = torch.from_numpy(grid.offset_m).to(cell.device)[offset]
        logits = details.query.heading_logits(agent_type, offset)
        turned_rad = _heading_rad(logits, uniforms, grid)
    position_m = regressed_m
    if position_m is None:
        position_m = torch.from_numpy(grid.centre_m).to(cell.device)[cell]
        if offset_m is not None:
            position_m = _within(position_m + offset_m, grid)
    ego_pose = entries.active(entries.token_step.pose)[:, EGO]
    pose = cell_pose(ego_pose, position_m)
    pose[:, 2] = wrap_angle(ego_pose[:, 2] + turned_rad)
    return InsertedAgent(cell, pose, agent_type, details.size_lwh_m[each, agent_type])


def _turned(
    details: InsertionDetails,
    each: Tensor,
    agent_type: Tensor,
    uniforms: UniformNumbers,
    grid: Grid,
) -> Tensor:
    """Headings relative to the ego."""
    if details.heading_logits is None:
        assert details.turned_rad is not None
        return details.turned_rad[each, agent_type]
    return _heading_rad(details.heading_logits[each, agent_type], uniforms, grid)


def _heading_rad(logits: Tensor, uniforms: UniformNumbers, grid: Grid) -> Tensor:
    """Sample headings relative to the ego."""
    bins = choose(logits, uniforms.draw(len(logits)))
    return (bins + 0.5) * (2 * math.pi / grid.num_headings) - math.pi


def _within(position_m: Tensor, grid: Grid) -> Tensor:
    """Move positions of the grid frame that are outside the grid to its rim."""
    far = position_m.norm(dim=-1, keepdim=True) / (INSIDE * grid.radius_m)
    return position_m / far.clamp(min=1)
