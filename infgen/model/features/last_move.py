"""How motion tokens differ from the last move: logits by changes of speed and heading.

An agent mostly goes on as it moved. Its features have to carry that move, by which the
motion head (``motion_head``) then chooses among two thousand tokens: at high speeds, of
which logs have few, agents were half a metre per second too slow after each token. Here
a motion token is described by what it changes of the last move, which is exact at any
speed, and the agent's features tell which changes are likely.

Shape letters as in ``layers``; K is the number of waves, V are the motion tokens.
"""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor, nn

from infgen.model.batching.frames import to_local
from infgen.model.features.motion_waves import wave_phases
from infgen.model.layers import begin_last_at_zero, by_agent_type, full_precision, mlp
from infgen.tokens.vocabulary import MotionVocabulary


@dataclass(frozen=True, slots=True)
class LastMove:
    """How agents moved in the last token step.

    Attributes:
        change: Where they ended, in the frames where they began, as a motion token's end
            pose: metres and radians.
        known: Whether that is known; just inserted agents have not moved.
    """

    change: Float32[Tensor, "row 3"]
    known: Bool[Tensor, " row"]

    @classmethod
    def between(
        cls,
        before: Float32[Tensor, "row 3"],
        pose: Float32[Tensor, "row 3"],
        known: Bool[Tensor, " row"],
    ) -> "LastMove":
        """Find the move from one pose to another."""
        return cls(to_local(pose, before), known)


class LastMoveHead(nn.Module):
    """What is added to logits of motion tokens for what they change of the last move.

    A logit is a sum of waves of the three changes, whose cosines and sines the agent
    weighs. The phase of a change is that of the token less that of the last move, so it is
    a product of what is known of tokens and of agents.
    """

    waves: Tensor

    def __init__(self, width: int, vocabulary: MotionVocabulary) -> None:
        super().__init__()
        phase = wave_phases(torch.from_numpy(vocabulary.end_pose.copy()))
        waves = torch.cat([phase.cos(), phase.sin()], dim=-1)
        self.register_buffer("waves", waves, persistent=False)  # [3, V, 2 K]
        self.weigh = mlp(width, width, waves.shape[-1])

    def begin_at_zero(self) -> None:
        """Change no logit until it is trained."""
        begin_last_at_zero(self.weigh)

    def forward(
        self, x_ND: Tensor, agent_type: Int64[Tensor, " row"], last: LastMove
    ) -> Tensor:
        """Compute what is added to logits [N, V]: nothing where no move is known.

        Args:
            x_ND: Features of the agents.
            agent_type: ``AgentType`` of each.
            last: How they moved.
        """
        weights: Tensor = self.weigh(x_ND)
        with full_precision(x_ND):
            even, odd = (weights.float() * last.known[:, None]).chunk(2, dim=-1)  # [N, K]
            phase = wave_phases(last.change)
            cos, sin = phase.cos(), phase.sin()
            asked = torch.cat([even * cos - odd * sin, even * sin + odd * cos], dim=-1)
            products = [partial(torch.matmul, other=waves.T) for waves in self.waves]
            found = by_agent_type(asked, agent_type, products)
        return found.to(x_ND.dtype)
