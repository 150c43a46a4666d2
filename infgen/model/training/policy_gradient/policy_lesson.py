"""One rollout of every scene of a batch, to learn from."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.model.batching.batch import Batch
from infgen.model.training.policy_gradient.insertion_overlaps import InsertionOverlaps
from infgen.tokens.scene_tokens import EGO
from infgen.tokens.vocabulary import MotionVocabulary


@dataclass(frozen=True, slots=True)
class AvoidedTokens:
    """Agents that took a motion token to be avoided, where there are others.

    Attributes:
        at: Rollout, token step at whose end the motion token ends, agent.
        avoided: Which motion tokens are to be avoided there, some but not all.
        taken: How many of those that were taken are, also where nothing is learned.
    """

    at: Int64[Tensor, "row 3"]
    avoided: Bool[Tensor, "row motion_token"]
    taken: int

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
        return AvoidedTokens(at, self.avoided[some], self.taken)


@dataclass(frozen=True, slots=True)
class PolicyLesson:
    """One rollout of every scene of a batch, to learn from.

    Attributes:
        batch: The rollouts.
        moved: Agents whose motion token was sampled.
        advantage: Of motion tokens, and of the cells, headings and offset tokens of
            inserted agents, at the token step that they led to.
        type_advantage: Of the type of every inserted agent.
        count_advantage: Of a rollout from a token step on: of its insertions there, and of
            the removals of the step before, whose agents are gone by then.
        conflicts: Motion tokens in conflict that were taken ...
        departures: ... and those by which vehicles left the road or stayed off it.
        insertion_overlaps: Places onto other agents, of all insertions.
        log_probability: Of all choices, in the order of ``choices_made``, by the network
            that the rollouts are of; None where it has not been trained since.
    """

    batch: Batch
    moved: Bool[Tensor, "scene token agent"]
    advantage: Float32[Tensor, "scene token agent"]
    type_advantage: Float32[Tensor, "scene token agent"]
    count_advantage: Float32[Tensor, "scene token"]
    conflicts: AvoidedTokens
    departures: AvoidedTokens
    insertion_overlaps: InsertionOverlaps
    log_probability: Float32[Tensor, " choice"] | None = None

    @property
    def removable(self) -> Bool[Tensor, "scene token agent"]:
        """Agents that might have been removed: those that moved, but for egos."""
        removable = self.moved.clone()
        removable[:, :, EGO] = False
        return removable
