"""What plays rollouts: a network, the words it speaks, and how its choices are sampled."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int16
from torch import Tensor

from infgen.model.relations import Rows
from infgen.model.stepping import Stepper
from infgen.model.token_step import TokenStep
from infgen.rollout.population import Population
from infgen.rollout.rules.rule_set import RuleSet
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
    def rules(self) -> RuleSet:
        """The value of every rule over the network's choices."""
        return self.settings.rule_set

    @property
    def inserts(self) -> bool:
        """Whether agents enter: they may, and the network can tell who."""
        return self.settings.inserts and self.stepper.insertion_and_removal

    @property
    def rates(self) -> Float64[np.ndarray, "3 2"] | None:
        """Mean, scale and persistence of latent rates, by ``Rate``; None without."""
        rates, share = self.stepper.network.rates, self.settings.latent_rate_scale
        if rates is None or not share:
            return None
        return rates().scaled(share).on_host().numpy()

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
        """Bring an array to the network's device; the host does not wait for that."""
        tensor = torch.from_numpy(values)
        if self.device.type == "cpu":
            return tensor
        return tensor.pin_memory().to(self.device, non_blocking=True)

    def fetch(self, *tensors: Tensor) -> list[np.ndarray]:
        """Bring tensors to the host, all in one copy: the host waits once."""
        if self.device.type == "cpu":
            return [each.numpy() for each in tensors]
        parts = [each.contiguous().view(torch.uint8).flatten() for each in tensors]
        held = torch.split(torch.cat(parts).cpu(), [len(part) for part in parts])
        return [
            part.clone().view(each.dtype).view(each.shape).numpy()
            for part, each in zip(held, tensors, strict=True)
        ]

    def rows(self, chosen: Bool[np.ndarray, "rollout row"]) -> Rows:
        """Number the chosen rows in order, as ``Rows.where``, without waiting."""
        at = np.flatnonzero(chosen)
        number = np.zeros(chosen.shape, dtype=np.int64)
        number.flat[at] = np.arange(len(at))
        return Rows(self.tensor(at), self.tensor(number))

    def token_step(
        self,
        population: Population,
        cells: Int16[np.ndarray, "rollout row"] | None = None,
        at: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> TokenStep:
        """Show a population to the network.

        Args:
            population: All agents.
            cells: Their cells, if they are known.
            at: Rollouts and rows of some agents only: they become a single rollout.
        """
        cells = population.cells(self.grid) if cells is None else cells

        def shown(values: np.ndarray) -> Tensor:
            return self.tensor(values if at is None else values[at][None])

        return TokenStep(
            agent_type=shown(population.agent_type).long(),
            size_lwh_m=shown(population.size_lwh_m),
            pose=shown(population.pose),
            motion_token=shown(population.motion_token).long(),
            presence=shown(population.presence).long(),
            observed=shown(population.observed),
            cell=shown(cells).long(),
        )
