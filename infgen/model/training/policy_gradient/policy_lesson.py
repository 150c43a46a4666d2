"""One rollout of every scene of a batch, to learn from."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Float32
from torch import Tensor

from infgen.model.batching.batch import Batch
from infgen.model.training.policy_gradient.avoided.insertion_overlaps import (
    InsertionOverlaps,
)
from infgen.model.training.policy_gradient.avoided.tokens import AvoidedTokens
from infgen.tokens.scene_tokens import EGO


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
        departures: ... those by which vehicles left the road or stayed off it ...
        creeping: ... and those by which they crept on.
        insertion_overlaps: Places onto other agents, of all insertions.
        rate_log_odds: What latent rates added to the log-odds of insertions and removals,
            by ``Rate``.
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
    creeping: AvoidedTokens
    insertion_overlaps: InsertionOverlaps
    rate_log_odds: Float[Tensor, "scene token 2"]
    log_probability: Float32[Tensor, " choice"] | None = None

    @property
    def removable(self) -> Bool[Tensor, "scene token agent"]:
        """Agents that might have been removed: those that moved, but for egos."""
        removable = self.moved.clone()
        removable[:, :, EGO] = False
        return removable
