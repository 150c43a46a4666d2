"""Anchors: a few motion tokens of each agent type that stand for all others.

Motion logits are a product of what an agent is told, in few numbers, and of where each
motion token leads; that one token ends clear of a box or a road edge and the next does not
is hard to tell that way. Features of each token by itself do, but there are two thousand
tokens. They change little from one to the next, so they are computed for anchors, and what
is made of them goes to the tokens that lead nearly as far.

Shape letters as in ``layers``; R anchors, P points, F features, C is the width of what is
learned of them, V are the motion tokens.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn
from torch.nn import functional

from infgen.clock import CLOCK
from infgen.model.layers import begin_last_at_zero, by_agent_type, mlp
from infgen.scene import AgentType
from infgen.tokens.vocabulary import MotionVocabulary

ANCHORS = 64
"""Anchors of each agent type, if it has as many motion tokens."""
SHARED_BY = 4
"""The nearest anchors, whose values a motion token takes."""
APART_S = 1.5
"""Anchors lie far apart at the end of the token and so long after its beginning ..."""
HEADING_M = 2.0
"""... and in heading, where a radian counts as so much."""
FINER_PER_M = 2.0
"""Of a token that is x metres long, lengths count less by the root of one plus so many
times x. Else 3 of the package's 64 anchors of vehicles are slower than 3 m/s, as one in
seven motion tokens is, and these take the values of anchors 0.4 m away."""

ROWS = 256
"""Rows at once on a CPU: what their features need stays in its cache."""


@dataclass(frozen=True, slots=True)
class Anchors:
    """Motion tokens that stand for all others of their agent type.

    Attributes:
        end_pose: Poses at their ends [3, R, 3] ...
        velocity_mps: ... and how agents move on from there [3, R, 2].
        share: How much of each motion token's value is each anchor's [3, R, V].
    """

    end_pose: np.ndarray
    velocity_mps: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, vocabulary: MotionVocabulary) -> "Anchors":
        """Choose anchors that lie far from each other."""
        end_pose = vocabulary.end_pose.astype(np.float64)
        velocity_mps = _velocity_mps(end_pose)
        heading_rad = end_pose[..., 2:]
        ends_m = end_pose[..., :2]
        length_m = np.linalg.norm(ends_m, axis=-1, keepdims=True)
        counts = (1 + FINER_PER_M * length_m) ** -0.5
        told = np.concatenate(
            [
                counts * ends_m,
                counts * (ends_m + velocity_mps * (APART_S - CLOCK.token_s)),
                HEADING_M * np.cos(heading_rad),
                HEADING_M * np.sin(heading_rad),
            ],
            axis=-1,
        )
        count = min(ANCHORS, told.shape[1])
        chosen = np.stack([_far_apart(each, count) for each in told])
        share = [_shares(each, at) for each, at in zip(told, chosen, strict=True)]
        kind = np.arange(len(chosen))[:, None]
        return cls(end_pose[kind, chosen], velocity_mps[kind, chosen], np.stack(share))

    def direction(self) -> tuple[np.ndarray, np.ndarray]:
        """Cosines and sines of the headings at their ends [3, R]."""
        heading_rad = self.end_pose[..., 2]
        return np.cos(heading_rad), np.sin(heading_rad)

    def place_m(self, time_s: float) -> Float32[np.ndarray, "3 R 2"]:
        """Where agents are so long after the beginning of the token."""
        moved_m = self.velocity_mps * (time_s - CLOCK.token_s)
        place_m: np.ndarray = (self.end_pose[..., :2] + moved_m).astype(np.float32)
        return place_m


class AnchorHead(nn.Module):
    """What agents make of features of anchors: what is added to logits of motion tokens."""

    share: Tensor

    def __init__(
        self, width: int, head_width: int, features: int, anchors: Anchors
    ) -> None:
        super().__init__()
        self.register_buffer("share", torch.from_numpy(anchors.share), persistent=False)
        self.gaps = nn.Linear(features, head_width)
        self.agent = nn.Linear(width, head_width, bias=False)
        self.ask = mlp(width, width, head_width)

    @property
    def anchors(self) -> int:
        """Number of anchors of each agent type."""
        return self.share.shape[1]

    def begin_at_zero(self) -> None:
        """Change no logit until it is trained."""
        begin_last_at_zero(self.ask)

    def judge(
        self,
        x_ND: Tensor,
        features: Float32[Tensor, "N R F"],
    ) -> Tensor:
        """Return what is added to the logits of anchors [N, R].

        Args:
            x_ND: Features of the agents.
            features: Features of the anchors of each.
        """
        told = self.gaps(features.to(x_ND.dtype)) + self.agent(x_ND)[:, None]  # [N, R, C]
        judged: Tensor = (functional.relu(told) @ self.ask(x_ND)[..., None])[..., 0]
        return judged

    def spread(self, judged: Tensor, agent_type: Int64[Tensor, " row"]) -> Tensor:
        """From anchors [N, R], of this head or others, to motion tokens [N, V]."""
        shares = self.share.to(judged.dtype)
        products = [partial(torch.matmul, other=share) for share in shares]
        return by_agent_type(judged, agent_type, products)


def row_parts(agent_type: Int64[Tensor, " row"]) -> list[slice]:
    """Parts of agents of which features are computed at once."""
    rows = len(agent_type)
    at_once = ROWS if agent_type.device.type == "cpu" else max(rows, 1)
    return [slice(begin, begin + at_once) for begin in range(0, rows, at_once)]


def _velocity_mps(end_pose: np.ndarray) -> np.ndarray:
    """How agents move on: as fast as before, and where they head; pedestrians as before."""
    away_m, heading_rad = end_pose[..., :2], end_pose[..., 2]
    way_m = np.copysign(np.linalg.norm(away_m, axis=-1), away_m[..., 0])
    headed_m = way_m[..., None] * np.stack([np.cos(heading_rad), np.sin(heading_rad)], -1)
    pedestrian = AgentType.PEDESTRIAN
    headed_m[pedestrian] = away_m[pedestrian]
    return headed_m / CLOCK.token_s


def _far_apart(points: np.ndarray, count: int) -> np.ndarray:
    """Choose points [count], each farthest from those before it; the first is the first."""
    chosen = np.zeros(count, dtype=np.int64)
    away = np.linalg.norm(points - points[0], axis=-1)
    for place in range(1, count):
        chosen[place] = away.argmax()
        away = np.minimum(away, np.linalg.norm(points - points[chosen[place]], axis=-1))
    return chosen


def _shares(points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Share out every point [V] among its nearest chosen points: [count, V]."""
    away = np.linalg.norm(points[chosen][:, None] - points, axis=-1)  # [count, V]
    nearest = np.argsort(away, axis=0, kind="stable")[:SHARED_BY]
    near = 1 / (np.take_along_axis(away, nearest, axis=0) ** 2 + 1e-4)
    share = np.zeros(away.shape, dtype=np.float32)
    np.put_along_axis(share, nearest, (near / near.sum(axis=0)).astype(np.float32), axis=0)
    return share
