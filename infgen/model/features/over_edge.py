"""Inserted boxes over road edges: logits of motion tokens by how far each goes.

Clearance from road edges (``edge_clearance``) compares where motion tokens lead. A box that
moves along an edge stays as far over it as one that stands, so the two look the same. Here
it is known how far the box of a just inserted agent is over the nearest edge: of logged
vehicles that are inserted across a road edge hardly one drives.

Shape letters as in ``anchors``.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor, nn

from infgen.model.features.edge_clearance import NOW, EdgesNear
from infgen.model.layers import full_precision
from infgen.tokens.vocabulary import MotionVocabulary

KNOTS_M = (-1.5, -0.75, -0.4, -0.2, -0.1, 0.0, 0.1, 0.25)
"""Between how far boxes are over an edge: how much of each interval is passed is told.
Farther off it all are alike: vehicles parked beside the road."""
DRIVES_M = 1.0
"""Motion tokens that go as far as this drive; shorter ones count for their share of it."""


class OverEdgeHead(nn.Module):
    """What is added to logits of motion tokens that drive, by where a box was inserted."""

    drives: Tensor
    now: Tensor
    knot_m: Tensor

    def __init__(self, width: int, vocabulary: MotionVocabulary) -> None:
        super().__init__()
        way_m = np.linalg.norm(vocabulary.end_pose[..., :2], axis=-1)
        drives = np.minimum(way_m / DRIVES_M, 1)  # [3, V]
        for name, array in (("drives", drives), ("now", NOW), ("knot_m", KNOTS_M)):
            buffer = torch.from_numpy(np.asarray(array, dtype=np.float32))
            self.register_buffer(name, buffer, persistent=False)
        self.say = nn.Linear(width, len(KNOTS_M) - 1)

    def begin_at_zero(self) -> None:
        """Change no logit until it is trained."""
        nn.init.zeros_(self.say.weight)
        nn.init.zeros_(self.say.bias)

    def forward(
        self,
        x_ND: Tensor,
        agent_type: Int64[Tensor, " row"],
        passed: Float32[Tensor, "row interval"],
    ) -> Tensor:
        """Compute what is added to logits [N, V].

        Args:
            x_ND: Features of the agents.
            agent_type: ``AgentType`` of each.
            passed: Intervals that they have passed.
        """
        said: Tensor = self.say(x_ND)
        odds = (said * passed.to(said.dtype)).sum(dim=1, keepdim=True)
        return odds * self.drives.to(odds.dtype)[agent_type]

    @torch.no_grad()
    def passed(
        self, edges: EdgesNear, inserted: Bool[Tensor, " row"]
    ) -> Float32[Tensor, "row interval"]:
        """Say how much of each interval just inserted boxes have passed; others none."""
        with full_precision(edges.told):
            over_m = edges.over_m(self.now).amax(dim=1, keepdim=True)
        low, high = self.knot_m[:-1], self.knot_m[1:]
        return ((over_m - low) / (high - low)).clamp(0, 1) * inserted[:, None]
