"""How fast vehicles drive, beside how fast the log's do.

Slow vehicles collide less, so that the other costs alone teach low speeds. The speed cost
is the gradient of an energy score of the speeds of one scene, each of these by itself:

- vehicles of the history, at one token step;
- vehicles inserted since, in their first token step, of all token steps together;
- the same vehicles later on, of all token steps together.

A scene inserts too few vehicles for a distribution of each token step.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.clock import CLOCK
from infgen.model.batching.batch import Agents
from infgen.model.training.policy_gradient.energy import energy_gradient
from infgen.model.training.policy_gradient.rollouts import (
    HISTORY_TOKENS,
    SimulatedRollouts,
)
from infgen.model.training.simulation import INSERTED
from infgen.scene import AgentType

FIRST, LATER = 0, 1
"""Groups of inserted vehicles; from ``HISTORY_TOKENS`` on, those of the history by their
token step."""


def speed_costs(
    rollouts: SimulatedRollouts,
) -> Float32[np.ndarray, "rollout token agent"]:
    """Compute the speed cost of every vehicle that moved, in m/s.

    Zero for other agents, and in a group without a vehicle in the log or with fewer than
    two in the rollouts.
    """
    agents, scenes = rollouts.batch.agents, rollouts.scenes
    own = _Speeds.of(agents, rollouts.moved, rollouts.inserted, rollouts.known)
    log = _logged(rollouts)
    cost = np.zeros(own.moves.shape, dtype=np.float32)
    for scene in range(scenes):
        at, ours = own.of_scene(slice(scene, None, scenes))
        _, logs = log.of_scene(slice(scene, scene + 1))
        cost[scene::scenes][at] = _gradient_by_group(ours, logs)
    return cost


@dataclass(frozen=True, slots=True)
class _Speeds:
    """Speeds of vehicles that move.

    Attributes:
        speed_mps: Mean speed of the token step.
        group: ``FIRST``, ``LATER``, or the token step of a vehicle of the history.
        moves: Which of them count.
    """

    speed_mps: Float32[np.ndarray, "rollout token agent"]
    group: Int64[np.ndarray, "rollout token agent"]
    moves: Bool[np.ndarray, "rollout token agent"]

    @classmethod
    def of(
        cls, agents: Agents, moved: Tensor, inserted: Tensor, known: Tensor
    ) -> "_Speeds":
        way_m = (agents.pose[:, 1:, :, :2] - agents.pose[:, :-1, :, :2]).norm(dim=-1)
        speed_mps = _behind(way_m / CLOCK.token_s)
        token = torch.arange(moved.shape[1], device=moved.device)[None, :, None]
        since = torch.where(_behind(inserted[:, :-1]), FIRST, LATER)
        group = torch.where(known[:, None], token, since)
        vehicle = (agents.agent_type == int(AgentType.VEHICLE))[:, None]
        return cls(
            *(each.numpy(force=True) for each in (speed_mps, group, moved & vehicle))
        )

    def of_scene(
        self, rows: slice
    ) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, np.ndarray]]:
        """Return where vehicles move [rollout, token, agent], and speeds and groups."""
        at = np.nonzero(self.moves[rows])
        return at, (self.speed_mps[rows][at], self.group[rows][at])


def _logged(rollouts: SimulatedRollouts) -> _Speeds:
    """Speeds of the log, in the token steps that the rollouts have simulated."""
    logged = rollouts.logged
    inserted = (logged.presence == INSERTED) & logged.visible
    moved = logged.observed & _behind(logged.visible[:, :-1]) & ~inserted
    moved[:, :HISTORY_TOKENS] = False
    return _Speeds.of(logged, moved, inserted, rollouts.known)


def _gradient_by_group(
    ours: tuple[np.ndarray, np.ndarray], logs: tuple[np.ndarray, np.ndarray]
) -> Float32[np.ndarray, " vehicle"]:
    """Compare each group of simulated vehicles with the same one of the log."""
    (speed_mps, group), (logged_mps, logged_group) = ours, logs
    cost = np.zeros(len(speed_mps), dtype=np.float32)
    for each in np.unique(group):
        rows = group == each
        logged = logged_mps[logged_group == each]
        cost[rows] = energy_gradient(speed_mps[rows], logged)
    return cost


def _behind(values: Tensor) -> Tensor:
    """Shift values to the next token step; the first has none."""
    return torch.cat([torch.zeros_like(values[:, :1]), values], dim=1)
