"""What an agent that is not where the log has it should do next: come back bit by bit.

Who learns to be back in one token step (SMART, CatK: SPEC 2.3, 7.1) learns leaps. Led
0.9 m too far along its way, a vehicle is to drive 1.8 m/s slower for half a second and then
at the log's speed again; presumably that is why motion tokens are expected to spread over
more speeds than logs have. Here it makes good a share of how far it is ahead of the log or
behind it, and one of how far aside; unless that is all, it faces where this leads.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float32
from torch import Tensor

from infgen.model.batching.frames import to_local, to_world
from infgen.model.training_settings import TrainSettings

LEAST_WAY_M = 0.75
"""Agents that go less in a token step face as they do; others face where they are led."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """Shares of a deviation from the log that are made good in one token step.

    Attributes:
        along: Of how far an agent is ahead of the log, or behind.
        lateral: Of how far it is aside.
    """

    along: float = 1.0
    lateral: float = 1.0

    @classmethod
    def of(cls, settings: TrainSettings) -> "Recovery":
        """Take the shares that settings name."""
        return cls(settings.along_recovery, settings.lateral_recovery)

    @property
    def is_whole(self) -> bool:
        """Whether agents are to be where the log has them one token step later."""
        return self.along == 1 and self.lateral == 1

    def target(
        self,
        pose: Float32[Tensor, "row 3"],
        logged: Float32[Tensor, "row 3"],
        next_logged: Float32[Tensor, "row 3"],
    ) -> Float32[Tensor, "row 3"]:
        """Say where agents should be one token step later.

        Args:
            pose: Where they are.
            logged: Where the log has them.
            next_logged: Where it has them one token step later.

        Returns:
            That pose, moved by what is left of the deviation.
        """
        if self.is_whole:
            return next_logged
        ahead_m, aside_m, turned_rad = to_local(pose, logged).unbind(-1)
        left_aside_m = (1 - self.lateral) * aside_m
        if self.lateral == 1:
            left_rad = torch.zeros_like(turned_rad)
        else:
            way_m = torch.linalg.vector_norm((next_logged - logged)[:, :2], dim=-1)
            faces_rad = torch.atan2(left_aside_m - aside_m, way_m.clamp(min=LEAST_WAY_M))
            kept_rad = (1 - self.lateral) * turned_rad
            left_rad = torch.where(way_m < LEAST_WAY_M, kept_rad, faces_rad)
        left = torch.stack([(1 - self.along) * ahead_m, left_aside_m, left_rad], dim=-1)
        return to_world(left, next_logged)


WHOLE_RECOVERY = Recovery()
"""Back to the log in one token step."""
