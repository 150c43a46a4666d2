"""One token step of many rollouts: input and output of the network.

Dims as in ``steps``. What a network has no head for is None in its answers.
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.model.logits import MotionOutputs
from infgen.tokens.scene_tokens import Presence


@dataclass(frozen=True, slots=True)
class TokenStep:
    """All agents of all rollouts at the end of one token step.

    Attributes:
        agent_type: ``AgentType``.
        size_lwh_m: Boxes.
        pose: Quantised x, y, heading (world frame of the scene).
        motion_token: Motion token that led here, ``FIRST_MOTION_TOKEN`` where entering,
            else ``NO_MOTION_TOKEN``.
        presence: ``Presence``. REMOVED is the last column of an agent.
        observed: False where absent, unseen or entering (as ``SceneTokens.observed``).
        cell: Cell of the ego's grid that holds the agent, or ``NO_CELL``.
    """

    agent_type: Int64[Tensor, "rollout row"]
    size_lwh_m: Float32[Tensor, "rollout row 3"]
    pose: Float32[Tensor, "rollout row 3"]
    motion_token: Int64[Tensor, "rollout row"]
    presence: Int64[Tensor, "rollout row"]
    observed: Bool[Tensor, "rollout row"]
    cell: Int64[Tensor, "rollout row"]

    @property
    def visible(self) -> Bool[Tensor, "rollout row"]:
        """Rows that others see: observed, or just inserted."""
        return self.observed | (self.presence == int(Presence.INSERTED))

    def take(self, rollouts: Int64[Tensor, " kept"]) -> "TokenStep":
        """Go on with some rollouts only."""
        return TokenStep(*(getattr(self, each.name)[rollouts] for each in fields(self)))

    def pick(self, at: Int64[Tensor, " chosen"]) -> "TokenStep":
        """Take some rows by their flat indices among [rollout, row]: a single rollout."""
        rows = (getattr(self, each.name).flatten(0, 1)[at] for each in fields(self))
        return TokenStep(*(values[None] for values in rows))

    def put(self, at: Int64[Tensor, " changed"], rows: "TokenStep") -> "TokenStep":
        """Return a token step with other agents in some rows. Inverse of ``pick``."""
        changed = []
        for each in fields(self):
            old, new = getattr(self, each.name), getattr(rows, each.name)[0]
            changed.append(old.flatten(0, 1).index_copy(0, at, new).view_as(old))
        return TokenStep(*changed)

    def write(self, at: Int64[Tensor, " changed"], rows: "TokenStep") -> None:
        """Do the same in place."""
        for each in fields(self):
            old, new = getattr(self, each.name), getattr(rows, each.name)[0]
            old.flatten(0, 1).index_copy_(0, at, new)

    def where(self, chosen: Bool[Tensor, "rollout row"], other: "TokenStep") -> "TokenStep":
        """Take the chosen rows of this, and the other rows of another token step."""
        merged = []
        for each in fields(self):
            own, others = getattr(self, each.name), getattr(other, each.name)
            mask = chosen if own.dim() == chosen.dim() else chosen[..., None]
            merged.append(torch.where(mask, own, others))
        return TokenStep(*merged)


@dataclass(frozen=True, slots=True)
class MotionStep:
    """What follows a column.

    Attributes:
        packed: Of the visible rows, one after the other; below, rows that are not visible
            hold zeros.
    """

    packed: MotionOutputs

    @property
    def motion_logits(self) -> Float32[Tensor, "rollout row motion_token"]:
        """Next motion token, by the row's own agent type's vocabulary."""
        return self.packed.rows.spread(self.packed.motion_logits)

    @property
    def remove_logit(self) -> Float32[Tensor, "rollout row"] | None:
        """Log-odds that the next token is the agent's last (REMOVED)."""
        logit = self.packed.remove_logit
        return None if logit is None else self.packed.rows.spread(logit)

    @property
    def pattern_logits(self) -> Float32[Tensor, "rollout row pattern"] | None:
        """When within the next token a log would show the agent."""
        logits = self.packed.pattern_logits
        return None if logits is None else self.packed.rows.spread(logits)


@dataclass(frozen=True, slots=True)
class PositionOutputs:
    """Whether one more agent enters at this column, and where.

    Attributes:
        add_logit: Log-odds of ADD against BEGIN MOTION.
        position_logits: Cell of the ego's grid, given ADD ...
        position_m: ... or the place itself, in the ego's grid frame.
    """

    add_logit: Float32[Tensor, " rollout"]
    position_logits: Float32[Tensor, "rollout cell"] | None
    position_m: Float32[Tensor, "rollout 2"] | None

    def take(self, rollouts: Int64[Tensor, " kept"]) -> "PositionOutputs":
        """Go on with some rollouts only."""
        cell, place = self.position_logits, self.position_m
        return PositionOutputs(
            self.add_logit[rollouts],
            None if cell is None else cell[rollouts],
            None if place is None else place[rollouts],
        )

    def put(self, rollouts: Int64[Tensor, " replaced"], others: "PositionOutputs") -> None:
        """Replace those of some rollouts, in place. Inverse of ``take``."""
        for each in fields(self):
            own, new = getattr(self, each.name), getattr(others, each.name)
            if own is not None:
                own.index_copy_(0, rollouts, new)
