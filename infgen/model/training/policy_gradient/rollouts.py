"""Rollouts of a batch by the network alone, several of each scene.

The first ``HISTORY_TOKENS`` token steps are the log's. From then on all agents move, are
removed and are inserted as the network samples, without rules, as in rollouts with
``rollout.rules=none``; a rollout ends where its log ends. So a token step of a rollout and
of its log can be compared.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from infgen.model.batching.batch import Agents, Batch
from infgen.model.batching.tensors import map_tensors
from infgen.model.network import Network
from infgen.model.sampling import choose
from infgen.model.step_memory import Insertions
from infgen.model.token_step import MotionStep, PositionOutputs
from infgen.model.training.own_choices import InsertedAgent
from infgen.model.training.policy_gradient.insertion_mask import (
    find_free,
    sample_free_agent,
)
from infgen.model.training.population_targets import (
    describe_details,
    inserted_details,
    insertions_of,
)
from infgen.model.training.simulation import (
    INSERTED,
    PRESENT,
    NextInsertions,
    Simulation,
    first_rows,
)

HISTORY_TOKENS = 2
"""Token steps of the log that a rollout begins with, as in WOMD."""


@dataclass(frozen=True, slots=True)
class SimulatedRollouts:
    """Rollouts of the scenes of a batch: the first of each scene, then the second, ...

    Attributes:
        batch: Their agents, insertions and details; the maps are one for each scene.
        logged: Agents as logged, in the same rows [rollout, ...].
        count: Rollouts of each scene.
        moved: Agents whose motion token the network sampled.
        inserted: Agents that the network inserted.
        known: Rows whose agent was there at the end of the history: it is the same one in
            the log, and in all rollouts of the scene.
        rate_log_odds: What latent rates added to log-odds, by ``Rate``.
    """

    batch: Batch
    logged: Agents
    count: int
    moved: Bool[Tensor, "rollout token agent"]
    inserted: Bool[Tensor, "rollout token agent"]
    known: Bool[Tensor, "rollout agent"]
    rate_log_odds: Float[Tensor, "rollout token 2"]

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return len(self.moved) // self.count

    def rows(self, number: int) -> slice:
        """Rows of one rollout of every scene."""
        return slice(number * self.scenes, (number + 1) * self.scenes)

    def only(self, number: int) -> Batch:
        """Take one rollout of every scene."""
        batch, rows = self.batch, self.rows(number)
        return replace(
            batch,
            agents=map_tensors(batch.agents, lambda x: x[rows]),
            entries=map_tensors(batch.entries, lambda x: x[rows]),
            details=map_tensors(batch.details, lambda x: x[rows]),
        )


@torch.no_grad()
def simulate_rollouts(
    network: Network,
    batch: Batch,
    count: int,
    top_p: float,
    seed: int,
    insertion_mask: bool = False,
    latent_rate_scale: float = 1.0,
) -> SimulatedRollouts:
    """Simulate rollouts of every scene of a batch.

    Args:
        network: The network; its mode (training or not) is kept.
        batch: Scenes as logged, without noise, on the network's device.
        count: Rollouts of each scene.
        top_p: Share of the probability that motion tokens are sampled from.
        seed: Of everything that is sampled.
        insertion_mask: Whether agents are inserted at free positions only.
        latent_rate_scale: Latent rates vary so much, beside what the network has learned.
    """
    learning = network.training
    try:
        simulation = _FreeSimulation(
            network, batch, count, top_p, seed, insertion_mask, latent_rate_scale
        )
        for token in range(1, simulation.logged.pose.shape[1]):
            simulation.rates.advance(token)
            simulation.move(token)
            simulation.insert(token)
    finally:
        network.train(learning)
    return simulation.found(batch)


class _FreeSimulation(Simulation):
    """Rollouts in simulation.

    Attributes:
        top_p: Share of the probability that motion tokens are sampled from.
        end_pose: End poses of motion tokens, for the insertion mask; None without.
        stationary: Motion tokens that stand still, by agent type.
        goes_on: Token steps that the log has [rollout, token].
        moved: Agents whose motion token was sampled [rollout, token, agent].
        known: Agents that are there at the end of the history [rollout, agent].
        vacant: Rows without an agent until then, in order, and behind them the others.
        room: How many vacant rows there are [rollout].
        used: How many of the vacant rows are in use [rollout].
    """

    def __init__(
        self,
        network: Network,
        batch: Batch,
        count: int,
        top_p: float,
        seed: int,
        insertion_mask: bool,
        latent_rate_scale: float,
    ) -> None:
        """Begin with the history as logged."""
        super().__init__(network, batch, seed, latent_rate_scale, count)
        logged, last = self.logged, min(HISTORY_TOKENS, self.logged.pose.shape[1]) - 1
        presence = logged.presence[:, last]
        stays = (presence == PRESENT) | (presence == INSERTED)
        vocabulary = network.motion_vocabulary()
        stationary = vocabulary.stationary
        self.top_p = top_p
        self.end_pose = vocabulary.end_pose if insertion_mask else None
        self.stationary = torch.from_numpy(stationary).to(presence.device)
        self.goes_on = _until_the_last(logged.visible.any(dim=2))
        self.moved = torch.zeros_like(logged.observed)
        self.known = stays & logged.visible[:, last]
        taken = logged.visible[:, : last + 1].any(dim=1)
        self.vacant = taken.long().argsort(dim=1, stable=True)
        self.room = (~taken).sum(dim=1)
        self.used = torch.zeros(len(presence), dtype=torch.int64, device=presence.device)
        self.asked[:, :HISTORY_TOKENS] = False
        if network.cells is None:
            self.asked[:] = False

    def move(self, token: int) -> None:
        """Move everybody, and remove whom the network removes."""
        said = self.stepper.motion_step(self.memory, self.token_step(token - 1))
        if token < HISTORY_TOKENS:
            return
        before = self.played.presence[:, token - 1]
        alive = (before == PRESENT) | (before == INSERTED)
        alive &= self.played.visible[:, token - 1] & self.goes_on[:, token, None]
        self.clear(token, ~alive)
        self.played.turn[:, token] = -1
        self.keep(token, alive)
        self._sample_motion(token, alive, said)
        self.remove(token, alive, said.remove_logit)
        cell = self.cells(self.played.pose[:, token], token)
        self.played.cell[:, token] = torch.where(alive, cell, self.played.cell[:, token])

    def next_insertions(self, token: int, turn: int, active: Tensor) -> NextInsertions:
        """Offer the next vacant row of each rollout."""
        used, last = self.used[active], self.vacant.shape[1] - 1
        row = self.vacant[active, used.clamp(max=last)]
        none = torch.zeros_like(row, dtype=torch.bool)
        return NextInsertions(row, none, used < self.room[active])

    def sample_agent(
        self, token: int, active: Tensor, entries: Insertions, query: PositionOutputs
    ) -> tuple[InsertedAgent, Tensor | None]:
        """Sample agents, at free positions if there is an insertion mask."""
        end_pose = self.end_pose
        if end_pose is None:
            return super().sample_agent(token, active, entries, query)

        def is_free(agent: InsertedAgent, places: Tensor) -> Tensor:
            return find_free(self.played, token, active[places], agent, end_pose)

        return sample_free_agent(
            self.stepper, entries, query, self.uniforms, self.network.grid, is_free
        )

    def is_inserted(self, token: int, turn: int, at: tuple[Tensor, Tensor]) -> None:
        """Write down the turn."""
        self.turns.count[at[0], token] += 1
        self.turns.add[at[0], token, turn] = True
        self.turns.agent[at[0], token, turn] = at[1]
        self.used[at[0]] += 1

    def found(self, batch: Batch) -> SimulatedRollouts:
        """Gather what was simulated, without rows that no agent took."""
        some = self.logged.visible | self.played.visible
        rows = int(some.any(dim=1).any(dim=0).nonzero().max()) + 1
        played, logged = first_rows(self.played, rows), first_rows(self.logged, rows)
        moved, known = self.moved[..., :rows], self.known[:, :rows]
        inserted = torch.zeros_like(moved)
        entries = insertions_of(self.turns, self.asked, played)
        details = inserted_details(entries, played)
        rollout = torch.arange(len(inserted), device=inserted.device)[:, None]
        rollout = rollout.expand_as(details.agent)[details.present]
        token, row = details.token[details.present], details.agent[details.present]
        inserted[rollout, token, row] = True
        return SimulatedRollouts(
            batch=replace(
                batch,
                agents=played,
                entries=entries,
                details=describe_details(details, played, self.network.grid),
            ),
            logged=logged,
            count=len(played.pose) // len(batch.agents.pose),
            moved=moved,
            inserted=inserted,
            known=known,
            rate_log_odds=self.rates.log_odds.float(),
        )

    def _sample_motion(self, token: int, who: Tensor, said: MotionStep) -> None:
        """Move agents as the network samples."""
        scene, row = who.nonzero(as_tuple=True)
        at = scene, row
        agent_type = self.played.agent_type[at]
        logits = said.packed.motion_logits[said.packed.rows.number[at]]
        uniform = self.uniforms.draw(*who.shape)[at]
        apart = self.stationary[agent_type]
        self.move_by(token, at, choose(logits, uniform, nucleus=self.top_p, apart=apart))
        self.moved[:, token] = who


def _until_the_last(some: Tensor) -> Tensor:
    """Mark the token steps [rollout, token] up to the last one that is marked."""
    return some.flip(1).long().cumsum(dim=1).flip(1) > 0
