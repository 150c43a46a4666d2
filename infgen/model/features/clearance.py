"""Clearance of motion tokens: how near others each of them would lead an agent.

The boxes of the agent and of others are moved on: the agent by the token, then as fast as
the token was; others as they moved in the last token step. What is left between them, along
and beside the agent's way, is a feature of the token (``anchors``).

Shape letters as in ``anchors``; K others, T times.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from infgen.clock import CLOCK
from infgen.model.features.anchors import AnchorHead, Anchors, row_parts
from infgen.model.features.approach import MovingPairs
from infgen.model.layers import full_precision
from infgen.tokens.vocabulary import MotionVocabulary

OTHERS = 8
"""Others that an agent keeps clear of: those that would come nearest."""
TIMES_S = (0.5, 1.0, 1.5, 2.0)
"""When gaps are computed, from the beginning of the motion token, which lasts the first."""
AHEAD_M = ((0.5, 0.25), (2.0, 0.25), (2.0, 1.0), (6.0, 0.5), (15.0, 0.5))
"""Gaps along and beside the way to others ahead at which a feature falls to 1 / e ..."""
BEHIND_M = ((0.5, 0.25), (2.0, 0.5), (6.0, 0.5))
"""... and to others behind."""
FAR_M = 1e4
"""A gap beyond all others, for others that are not there."""


class Clearance(AnchorHead):
    """How agents judge motion tokens by the gaps to others that they would leave."""

    ways: Tensor
    headings: Tensor
    per_m: Tensor
    times_s: Tensor

    def __init__(
        self, width: int, clearance_width: int, vocabulary: MotionVocabulary
    ) -> None:
        anchors = Anchors.of(vocabulary)
        scales = len(AHEAD_M) + len(BEHIND_M)
        super().__init__(width, clearance_width, scales * (len(TIMES_S) + 1), anchors)
        for name, array in (
            ("ways", _ways(anchors)),
            ("headings", _headings(anchors)),
            ("per_m", _per_m()),
            ("times_s", np.array((0.0, *TIMES_S), dtype=np.float32)),
        ):
            self.register_buffer(name, torch.from_numpy(array), persistent=False)

    def forward(
        self, x_ND: Tensor, agent_type: Int64[Tensor, " row"], moving: MovingPairs
    ) -> Tensor:
        """Judge the anchors of agents: what is added to their logits [N, R].

        Args:
            x_ND: Features of the agents.
            agent_type: ``AgentType`` of each.
            moving: How they move, and the others around each.
        """
        return self.judge(x_ND, self.features(agent_type, moving))

    @torch.no_grad()
    def features(self, agent_type: Tensor, moving: MovingPairs) -> Float32[Tensor, "N R F"]:
        """Describe the gaps that the anchors leave, 1 for none to 0 for wide ones."""
        none = moving.pose.new_zeros((0, self.anchors, self.gaps.in_features))
        if not moving.index.shape[1]:
            return none.new_zeros((len(agent_type), *none.shape[1:]))
        with full_precision(moving.pose):
            parts = [
                self._features(agent_type[part], NearOthers.of(moving, part, self.times_s))
                for part in row_parts(agent_type)
            ]
        return torch.cat([none, *parts])

    def _features(self, agent_type: Tensor, others: "NearOthers") -> Tensor:
        """The same of some rows."""
        ways = self.ways[agent_type]  # [n, 2, 5, T R]
        along_m, beside_m = (others.place @ way for way in ways.unbind(1))  # [n, K, T R]
        half_m = others.half_across(self.headings[agent_type]).repeat(1, 1, 1, len(TIMES_S))
        gap_m = (along_m.abs() - half_m[0]).clamp(min=0)
        aside_m = (beside_m.abs() - half_m[1]).clamp(min=0)
        is_ahead = along_m > 0
        found = []
        for which, times in ((others.known, len(TIMES_S)), (others.unknown, 1)):
            upto = times * self.anchors
            for on_side, scales in ((is_ahead, AHEAD_M), (~is_ahead, BEHIND_M)):
                counts = on_side[..., :upto] & which[..., None]
                way_m = torch.where(counts, gap_m[..., :upto], FAR_M)
                for scale_m, across_m in scales:
                    # A gap beside the way is as good as one along it of so much.
                    as_way_m = torch.add(
                        way_m, aside_m[..., :upto], alpha=scale_m / across_m
                    )
                    found.append(as_way_m.amin(dim=1).view(-1, times, self.anchors))
        return (torch.cat(found, dim=1) * self.per_m[:, None]).exp().mT


@dataclass(frozen=True, slots=True)
class NearOthers:
    """Others near agents, in the agents' frames; K of each.

    Attributes:
        place: Where they are, how far they get in a second, and 1 [N, K, 5].
        turned: Cosine and sine of their headings [N, K, 2].
        half_m: Half of the lengths and widths of their boxes [N, K, 2] ...
        own_half_m: ... and of the agents' [N, 2].
        known: Which of them move as is known [N, K] ...
        unknown: ... and which have just been inserted.
    """

    place: Tensor
    turned: Tensor
    half_m: Tensor
    own_half_m: Tensor
    known: Tensor
    unknown: Tensor

    @classmethod
    def of(cls, moving: MovingPairs, rows: slice, times_s: Tensor) -> "NearOthers":
        """Find those that come nearest to some rows if all move on as they did.

        Args:
            moving: How agents move.
            rows: Which of them.
            times_s: When others may be nearest.
        """
        index, present = moving.index[rows], moving.present[rows]
        pose, other = moving.pose[rows, None], moving.pose[index]
        per_s = 1 / CLOCK.token_s
        own_mps, other_mps = moving.step_m[rows, None] * per_s, moving.step_m[index] * per_s
        away_m, to_mps = (other - pose)[..., :2], other_mps - own_mps
        later_m = away_m[..., None, :] + to_mps[..., None, :] * times_s[:, None]
        nearest_m2 = later_m.square().sum(dim=-1).amin(dim=-1)
        nearest_m2 = torch.where(present, nearest_m2, torch.inf)
        at = nearest_m2.topk(min(OTHERS, index.shape[1]), dim=1, largest=False).indices

        def chosen(values: Tensor) -> Tensor:
            return values.gather(1, at[..., None].expand(-1, -1, values.shape[-1]))

        cos, sin = pose[..., 2].cos(), pose[..., 2].sin()

        def local(vector: Tensor) -> list[Tensor]:
            x, y = vector.unbind(-1)
            return [cos * x + sin * y, cos * y - sin * x]

        away_m, other_mps, other = chosen(away_m), chosen(other_mps), chosen(other)
        turned_rad = other[..., 2] - pose[..., 2]
        place = [*local(away_m), *local(other_mps), torch.ones_like(turned_rad)]
        near, known = present.gather(1, at), moving.known[index].gather(1, at)
        return cls(
            torch.stack(place, dim=-1),
            torch.stack([turned_rad.cos(), turned_rad.sin()], dim=-1),
            chosen(moving.size_lw_m[index]) / 2,
            moving.size_lw_m[rows] / 2,
            near & known,
            near & ~known,
        )

    def half_across(
        self, headings: Float32[Tensor, "n 2 2 R"]
    ) -> Float32[Tensor, "2 n K R"]:
        """How far both boxes reach, together, along and beside each anchor's way."""
        cos, sin = ((self.turned @ each).abs() for each in headings.unbind(1))
        length, width = self.half_m[..., :1], self.half_m[..., 1:]
        own = self.own_half_m.mT[..., None, None]
        return torch.stack([cos * length + sin * width, sin * length + cos * width]) + own


def _ways(anchors: Anchors) -> Float32[np.ndarray, "3 2 5 times_anchors"]:
    """What ``NearOthers.place`` is multiplied by: places along and beside the ways."""
    cos, sin = anchors.direction()
    found = []
    for to_x, to_y in ((cos, sin), (-sin, cos)):
        at_times = []
        for time_s in TIMES_S:
            own_m = (anchors.place_m(time_s) * np.stack([to_x, to_y], axis=-1)).sum(axis=-1)
            told = [to_x, to_y, to_x * time_s, to_y * time_s, -own_m]
            at_times.append(np.stack(told, axis=1))
        found.append(np.concatenate(at_times, axis=-1))
    return np.stack(found, axis=1).astype(np.float32)


def _per_m() -> Float32[np.ndarray, " feature"]:
    """What the logarithm of each feature changes by in a metre along the way."""
    scale_m = [scale for scale, _ in (*AHEAD_M, *BEHIND_M)]
    per_m = -1 / np.array(scale_m, dtype=np.float32)
    return np.concatenate([per_m.repeat(len(TIMES_S)), per_m])


def _headings(anchors: Anchors) -> Float32[np.ndarray, "3 2 2 anchor"]:
    """What ``NearOthers.turned`` is multiplied by: headings to the ways."""
    cos, sin = anchors.direction()
    told = [np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)]
    return np.stack(told, axis=1).astype(np.float32)
