"""What temporal attention is too short for: how dense traffic has been, who has stood.

Temporal attention sees a few seconds. Two things have to be known for longer: how many
agents there were around the ego, or a rollout forgets how full the street was; and for how
long an agent has stood, and whether it has ever driven, or a vehicle that waits is taken
for parked. Both are kept as a few numbers, updated once a token step, and enter the network
as features whose last layer begins at zero: weights that were trained without them give the
same logits with them.

Training computes them for all token steps at once, the stepper one token step at a time.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor, nn
from torch.nn.functional import pad

from infgen.model.layers import begin_last_at_zero, mlp
from infgen.model.relations import within_radius
from infgen.model.token_step import TokenStep
from infgen.tokens.scene_tokens import Presence

AVERAGED_TOKENS = (6, 60)
"""Time constants, in token steps, of the moving averages of the number of agents: 3 s for
its recent course, 30 s for how dense traffic has been."""
MOVED_M = 0.5
"""An agent that gets no farther in one token step stands."""
MAX_STOOD_TOKENS = 16
"""Longer standing is seen as this long: about the longest that training windows show."""


@dataclass(frozen=True, slots=True)
class Density:
    """How many agents there are around egos.

    Attributes:
        count: How many there are now.
        average: Moving averages of that number over earlier token steps.
    """

    count: Float32[Tensor, "*ego"]
    average: Float32[Tensor, "*ego constant"]

    def take(self, egos: Int64[Tensor, " row"]) -> "Density":
        """Take flat rows, each as often as it is named."""
        return Density(self.count.flatten()[egos], self.average.flatten(0, -2)[egos])


class DensityFeatures(nn.Module):
    """How many agents are around the ego, and how that compares with before."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.embed = mlp(1 + len(AVERAGED_TOKENS), width, width)

    def begin_at_zero(self) -> None:
        """Let the features be zero at first."""
        begin_last_at_zero(self.embed)

    def forward(self, density: Density) -> Tensor:
        """Describe traffic densities [..., D]."""
        now, before = density.count.log1p()[..., None], density.average.log1p()
        told: Tensor = self.embed(torch.cat([now, now - before], dim=-1))
        return told


def count_around(
    ego_pose: Float32[Tensor, "*ego 3"],
    pose: Float32[Tensor, "*ego agent 3"],
    visible: Bool[Tensor, "*ego agent"],
    radius_m: float,
) -> Float32[Tensor, "*ego"]:
    """Count the visible agents within a radius of egos, these included."""
    near = within_radius(ego_pose[..., None, :].expand_as(pose), pose, radius_m)
    return (near & visible).sum(dim=-1).to(pose.dtype)


def averages_before(
    count: Float32[Tensor, "scene token"],
) -> Float32[Tensor, "scene token constant"]:
    """Average the number of agents over all token steps before each.

    At the first token step, before which nothing is known, the averages are its own number.
    Summed, as a matrix product would lose digits under autocast and in TF32.
    """
    tokens = torch.arange(count.shape[1], device=count.device)
    ago = tokens[:, None] - 1 - tokens  # [token, earlier token]
    found = []
    for constant in AVERAGED_TOKENS:
        rest = 1 - 1 / constant
        share = torch.where(ago >= 0, rest ** ago.clamp(min=0) / constant, 0.0)
        share[:, 0] += rest**tokens  # The first number stands for all before it.
        found.append((count[:, None] * share).sum(dim=-1))
    return torch.stack(found, dim=-1)


def next_averages(
    average: Float32[Tensor, "rollout constant"],
    count: Float32[Tensor, " rollout"],
    first: Bool[Tensor, " rollout"],
) -> Float32[Tensor, "rollout constant"]:
    """Update the averages of ``averages_before`` by one token step."""
    # Filled one by one, as the host would wait for a copy.
    share = torch.stack([count.new_full((), 1 / each) for each in AVERAGED_TOKENS])
    moved = average + share * (count[:, None] - average)
    return torch.where(first[:, None], count[:, None], moved)


@dataclass(frozen=True, slots=True)
class Standing:
    """For how long agents have stood.

    Attributes:
        tokens: Token steps since the agent last moved, or since it was first seen.
        moved: Whether it has ever been seen moving.
    """

    tokens: Int64[Tensor, "..."]
    moved: Bool[Tensor, "..."]

    @classmethod
    def unknown(cls, like: Tensor) -> "Standing":
        """No agent has been seen yet."""
        return cls(torch.zeros_like(like, dtype=torch.int64), torch.zeros_like(like) > 0)

    def take(self, rows: Int64[Tensor, " row"]) -> "Standing":
        """Take flat rows."""
        return Standing(self.tokens.flatten()[rows], self.moved.flatten()[rows])

    def put(self, rollouts: Int64[Tensor, " replaced"], others: "Standing") -> None:
        """Replace some rollouts."""
        self.tokens[rollouts], self.moved[rollouts] = others.tokens, others.moved

    def with_rows(self, more: int) -> "Standing":
        """Append free rows."""
        return Standing(pad(self.tokens, (0, more)), pad(self.moved, (0, more)))


def standing_after(
    standing: Standing | None, before: Tensor, known: Tensor, token_step: TokenStep
) -> Standing | None:
    """Go on by one token step; None if it is not used.

    Args:
        standing: Before the token step.
        before: Poses one token step earlier [rollout, row, 3] ...
        known: ... and whether they were seen.
        token_step: The token step.
    """
    if standing is None:
        return None
    pose, presence = token_step.pose, token_step.presence
    moves = moves_between(before, known, pose, presence) & token_step.visible
    inserted = presence == int(Presence.INSERTED)
    return Standing(
        tokens=torch.where(inserted | moves, 0, standing.tokens + 1),
        moved=(standing.moved | moves) & ~inserted,
    )


def standing_at(
    presence: Int64[Tensor, "scene token agent"],
    moves: Bool[Tensor, "scene token agent"],
) -> Standing:
    """Tell for all token steps what ``standing_after`` tells one after the other."""
    token = torch.arange(presence.shape[1], device=presence.device)[:, None]
    born = _latest(torch.where(presence == int(Presence.INSERTED), token, 0))
    moved = _latest(torch.where(moves, token, -1))
    return Standing(token - torch.maximum(born, moved), moved > born)


def moves_between(
    before: Float32[Tensor, "*agent 3"],
    known: Bool[Tensor, "*agent"],
    pose: Float32[Tensor, "*agent 3"],
    presence: Int64[Tensor, "*agent"],
) -> Bool[Tensor, "*agent"]:
    """Tell which agents have moved since the last token step.

    Args:
        before: Poses one token step earlier ...
        known: ... and whether they were seen.
        pose: Poses now.
        presence: ``Presence`` now; inserted agents have not moved yet.
    """
    square_m2 = (pose[..., :2] - before[..., :2]).square().sum(dim=-1)
    return known & (square_m2 > MOVED_M**2) & (presence != int(Presence.INSERTED))


class StandingFeatures(nn.Module):
    """For how long an agent has stood, and whether it has ever driven."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.embed = mlp(2, width, width)

    def begin_at_zero(self) -> None:
        """Let the features be zero at first."""
        begin_last_at_zero(self.embed)

    def forward(self, standing: Standing) -> Tensor:
        """Describe agents [..., D]."""
        stood = standing.tokens.clamp(max=MAX_STOOD_TOKENS).float().log1p()
        share = stood / math.log1p(MAX_STOOD_TOKENS)
        told: Tensor = self.embed(torch.stack([share, standing.moved.float()], dim=-1))
        return told


def _latest(marks: Tensor) -> Tensor:
    """Largest mark up to each token step [scene, token, agent]."""
    return marks.cummax(dim=1).values
