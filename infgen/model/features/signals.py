"""The light ahead: what it shows an agent on its own lane, and since when.

Among all the map tokens that an agent sees, those of its own lane's light are few, and
when it last changed stands nowhere. So each agent gets both for the stop lines ahead as
features.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor, nn

from infgen.model.batching.batch import MapTokens
from infgen.model.layers import embedding_mlp
from infgen.tokens.scene_tokens import SignalClass
from infgen.tokens.signals import REMEMBERED

CLASSES = len(SignalClass) + REMEMBERED
"""What a light may show, looked at or remembered."""
PASSED_M = 1.0
"""A line is ahead until an agent's centre is so far beyond it."""
ASIDE_M = 2.0
"""Lines farther to the side are those of other lanes."""
TURNED_RAD = math.radians(30)
"""Lanes that differ more in direction are not the agent's own."""
LONG_SINCE = 4
"""Token steps after which it makes no difference how long a light has shown the same."""


@dataclass(frozen=True, slots=True)
class StopLines:
    """Where lanes with a traffic light begin, and what the lights show.

    Attributes:
        pose: Poses; padding is anywhere [scene, line, 3].
        light: Light of each, counted from 1; 0 for padding [scene, line].
        shown: ``SignalClass`` by the token step, ``REMEMBERED`` or not; the last one
            lasts [scene, light, token].
        since: Token steps it has shown it, up to ``LONG_SINCE`` [scene, light, token].
    """

    pose: Float32[Tensor, "scene line 3"]
    light: Int64[Tensor, "scene line"]
    shown: Int64[Tensor, "scene light token"]
    since: Int64[Tensor, "scene light token"]

    @classmethod
    def of(cls, roads: MapTokens) -> "StopLines":
        """Find the lines of maps: the first map tokens of lanes with a light."""
        starts = roads.real & (roads.light > 0) & ~roads.follows
        lines = int(starts.sum(dim=1).max()) if starts.numel() else 0
        first = starts.to(torch.int8).argsort(dim=1, descending=True, stable=True)
        first = first[:, :lines]
        return cls(
            roads.pose.gather(1, first[..., None].expand(-1, -1, 3)),
            roads.light.gather(1, first) * starts.gather(1, first),
            roads.shown,
            _since(roads.shown),
        )

    def ahead(
        self,
        pose: Float32[Tensor, "row 3"],
        scene: Int64[Tensor, " row"],
        token: Int64[Tensor, " row"],
        reach_m: float,
    ) -> Float32[Tensor, "row feature"]:
        """Tell every row of the lines ahead: of each class the nearest and the latest.

        Args:
            pose: Poses.
            scene: Map of each.
            token: Token step of each: signals are those of that step.
            reach_m: How far ahead.

        Returns:
            Of each class whether some line shows it, how near the nearest is (1 at the
            agent, 0 at ``reach_m``), and whether the latest has done so for more than 0,
            1, ... token steps.
        """
        if not self.shown.numel() or not self.light.shape[1]:
            return pose.new_zeros(len(pose), features())
        light = self.light[scene]
        away_m, mine = _lines_ahead(pose, self.pose[scene], reach_m)
        mine &= light > 0
        at = scene[:, None], (light - 1).clamp(min=0)
        late = token.clamp(max=self.shown.shape[2] - 1)[:, None]
        shown = self.shown[(*at, late)]
        since = self.since[(*at, late)] + (token[:, None] - late)
        far_m = _least(away_m, shown, mine)
        latest = _least(since.to(pose.dtype), shown, mine)
        there = far_m.isfinite()
        near = (1 - far_m.clamp(min=0) / reach_m).where(there, 0.0)
        steps = torch.arange(LONG_SINCE, device=pose.device)
        lasting = there[..., None] & (latest[..., None] > steps)
        told = torch.cat([there[..., None], near[..., None], lasting], dim=-1)
        return told.to(pose.dtype).flatten(1)

    def shown_ahead(
        self,
        pose: Float32[Tensor, "row 3"],
        scene: Int64[Tensor, " row"],
        token: Int64[Tensor, " row"],
        reach_m: float,
    ) -> Bool[Tensor, "row shown"]:
        """Tell every row whether a line ahead shows each class, or did when last seen."""
        told = self.ahead(pose, scene, token, reach_m)
        there = told.view(len(pose), CLASSES, 2 + LONG_SINCE)[..., 0] > 0
        return there[:, :REMEMBERED] | there[:, REMEMBERED:]


def features() -> int:
    """Number of features of ``StopLines.ahead``."""
    return CLASSES * (2 + LONG_SINCE)


class SignalAhead(nn.Module):
    """Embed what the lights ahead show."""

    def __init__(self, width: int, reach_m: float) -> None:
        super().__init__()
        self.reach_m = reach_m
        self.embed = embedding_mlp(features(), width)

    def forward(
        self, lines: StopLines, pose: Tensor, scene: Tensor, token: Tensor
    ) -> Tensor:
        """Tell rows, as ``StopLines.ahead`` has them [N, D]."""
        told: Tensor = self.embed(lines.ahead(pose, scene, token, self.reach_m))
        return told


def _since(shown: Int64[Tensor, "scene light token"]) -> Int64[Tensor, "scene light token"]:
    """Token steps that lights have shown the same, looked at or not.

    The time before the first one is unknown and counts as long.
    """
    token = torch.arange(shown.shape[2], device=shown.device)
    colour = shown % REMEMBERED
    changed = torch.zeros_like(shown, dtype=torch.bool)
    changed[..., 1:] = colour[..., 1:] != colour[..., :-1]
    last = torch.where(changed, token, -LONG_SINCE)
    if shown.shape[2]:
        last = last.cummax(dim=2).values
    return (token - last).clamp(max=LONG_SINCE)


def _lines_ahead(
    pose: Float32[Tensor, "row 3"], line: Float32[Tensor, "row line 3"], reach_m: float
) -> tuple[Float32[Tensor, "row line"], Bool[Tensor, "row line"]]:
    """How far ahead lines are, and which are on an agent's own lane."""
    heading_rad = pose[:, None, 2]
    cos, sin = heading_rad.cos(), heading_rad.sin()
    x_m, y_m = (line[..., :2] - pose[:, None, :2]).unbind(-1)
    ahead_m, aside_m = cos * x_m + sin * y_m, cos * y_m - sin * x_m
    mine = (ahead_m > -PASSED_M) & (ahead_m < reach_m) & (aside_m.abs() < ASIDE_M)
    mine &= (line[..., 2] - heading_rad).cos() > math.cos(TURNED_RAD)
    return ahead_m, mine


def _least(
    value: Float32[Tensor, "row line"],
    shown: Int64[Tensor, "row line"],
    counted: Bool[Tensor, "row line"],
) -> Float32[Tensor, "row shown"]:
    """Least value of each class; infinite where no line shows it."""
    least = value.new_full((len(value), CLASSES), torch.inf)
    value = value.where(counted, torch.inf)
    return least.scatter_reduce(1, shown, value, reduce="amin")
