"""What plays rollouts: a network, the words it speaks, and how its choices are sampled."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from infgen.model.stepping import Stepper
from infgen.model.token_step import TokenStep
from infgen.rollout.population import Population
from infgen.rollout.random_streams import Purpose, Streams
from infgen.rollout.settings import RolloutSettings
from infgen.tokens.grid import Grid, make_grid
from infgen.tokens.settings import TokenSettings
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary


@dataclass(frozen=True, slots=True)
class Simulator:
    """What plays: a network, the words it speaks, and how its choices are sampled.

    Attributes:
        stepper: The network, ready to be played.
        vocabulary: Its motion tokens.
        roads: Its map tokens.
        tokens: How histories are tokenized for it.
        settings: Length, sampling and caps.
        device: Where the network is.
    """

    stepper: Stepper
    vocabulary: MotionVocabulary
    roads: MapVocabulary
    tokens: TokenSettings
    settings: RolloutSettings
    device: torch.device

    @property
    def grid(self) -> Grid:
        """Cells and headings that inserted agents are placed in."""
        return make_grid(self.tokens)

    @property
    def inserts(self) -> bool:
        """Whether agents enter: they may, and the network can tell who."""
        return self.settings.inserts and self.stepper.insertion_and_removal

    @property
    def simulates(self) -> str:
        """What these weights and settings play, in words."""
        removes = self.stepper.leaves or self.settings.removal_radius_m > 0
        words = [
            word
            for word, done in (
                ("entries", self.inserts),
                ("exits", removes and self.settings.removes),
            )
            if done
        ]
        return ", ".join(["motion", *words]) if words else "motion only"

    def tensor(self, values: np.ndarray) -> Tensor:
        """Bring an array to the network's device."""
        return torch.from_numpy(values).to(self.device)

    def draw_uniforms(
        self,
        streams: Streams,
        token: int,
        purpose: Purpose,
        count: int,
        turn: int = 0,
    ) -> Tensor:
        """Draw [rollout, count] uniform numbers on the network's device."""
        return self.tensor(streams.uniform(token, purpose, count, turn))

    def token_step(self, population: Population) -> TokenStep:
        """Show a population to the network."""
        return TokenStep(
            agent_type=self.tensor(population.agent_type).long(),
            size_lwh_m=self.tensor(population.size_lwh_m),
            pose=self.tensor(population.pose),
            motion_token=self.tensor(population.motion_token).long(),
            presence=self.tensor(population.presence).long(),
            observed=self.tensor(population.observed),
            cell=self.tensor(population.cells(self.grid)).long(),
        )
