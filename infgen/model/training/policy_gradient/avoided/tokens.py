"""Motion tokens that are to be avoided, where agents took one of them."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from infgen.tokens.vocabulary import MotionVocabulary


@dataclass(frozen=True, slots=True)
class AvoidedTokens:
    """Agents that took a motion token to be avoided, where there are others.

    Attributes:
        at: Rollout, token step at whose end the motion token ends, agent.
        avoided: Which motion tokens are to be avoided there, some but not all.
        taken: How many of those that were taken are, also where nothing is learned.
        excess: Share of them that are more than in the logs; 1 if logs have none.
    """

    at: Int64[Tensor, "row 3"]
    avoided: Bool[Tensor, "row motion_token"]
    taken: int
    excess: float = 1.0

    @classmethod
    def none(cls, vocabulary: MotionVocabulary, device: torch.device) -> "AvoidedTokens":
        """Return none at all."""
        size = 0, vocabulary.num_motion_tokens
        avoided = torch.zeros(size, dtype=torch.bool, device=device)
        return cls(torch.zeros((0, 3), dtype=torch.int64, device=device), avoided, 0)

    @classmethod
    def where_some(
        cls,
        at: Int64[np.ndarray, "row 3"],
        avoided: Bool[np.ndarray, "row motion_token"],
        taken: int,
        device: torch.device,
    ) -> "AvoidedTokens":
        """Keep the rows that have a motion token which is not to be avoided."""
        some = ~avoided.all(axis=1)
        rows, tokens = (torch.from_numpy(x[some]).to(device) for x in (at, avoided))
        return cls(rows, tokens, taken)

    def only(self, rows: slice) -> "AvoidedTokens":
        """Take those of some rollouts, numbered from the first of them."""
        rollout = self.at[:, 0]
        some = (rollout >= rows.start) & (rollout < rows.stop)
        at = self.at[some]
        at[:, 0] -= rows.start
        return replace(self, at=at, avoided=self.avoided[some])
