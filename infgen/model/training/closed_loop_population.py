"""Closed-loop fine-tuning of insertion and removal: the network's own population.

``closed_loop`` keeps who is there as the log has it. Here the network itself inserts and
removes agents while the scene is simulated, and learns from the state that it gets into:

- At every token step each agent is removed with the probability that the network gives it,
  and at every insertion turn one more is inserted with the probability that it gives.
- An agent of the log that is not simulated is *missing*; one that is simulated but not, or
  no longer, in the log is *surplus*. The *excess* is the number of the ones less the other.
- As many insertions and removals are to be learned as the log has in this token step,
  corrected by a share of the excess: half of the correction by insertions, half by
  removals, so that in the mean the flow is that of the log. What cannot be corrected yet,
  fewer insertions where the log has none, say, is corrected later: else excess would be
  corrected mostly by more removals, and its lack by more insertions. To be inserted are
  missing agents, those first that came into view last, but none where another is
  simulated: the network would learn to insert agents onto others. To be removed are
  those whom the log removes, and for those of them whom the network has removed before,
  surplus agents in their place, sampled by how ready the network is to remove them.
  Excess is that within the radius of the grid. Of agents beyond it, where none can be
  inserted, as many are to be removed as there are more than in the log.
- An insertion that the network makes is that of the next agent to be inserted, at its
  logged pose. If none is to be inserted it is of one that it samples, and then nothing is
  learned of later turns. In a share of all insertions it samples in any case, as in
  rollouts, where as many insertions keep fewer agents than at logged poses.

To remove all surplus and to insert all missing agents at once, the obvious targets, would
teach several times the flow of the log: it cannot be seen who is surplus, so all agents
would have to be removed at the rate at which surplus ones are found among them.

Agents with a logged counterpart move as in ``closed_loop``, or as the batch has it; surplus
ones move as the network samples, and teach no motion.
"""

import torch
from torch import Tensor

from infgen.geometry import boxes_overlap
from infgen.model.batching.batch import Agents, Batch
from infgen.model.batching.padding import NO_AGENT
from infgen.model.batching.recovery import WHOLE_RECOVERY, Recovery
from infgen.model.latent_rates import Rate
from infgen.model.network import Network
from infgen.model.relations import within_radius
from infgen.model.sampling import choose
from infgen.model.training.closed_loop import move_near_log
from infgen.model.training.population_targets import targets
from infgen.model.training.rate_samples import LEAST_UNIFORM
from infgen.model.training.simulation import (
    ABSENT,
    INSERTED,
    PRESENT,
    REMOVED,
    NextInsertions,
    Simulation,
    first_rows,
)
from infgen.scene import AgentType
from infgen.tokens.insertion import insertion_key
from infgen.tokens.scene_tokens import EGO, NO_CELL

CORRECTION_TOKENS = 6
"""The excess is corrected in about so many token steps (3 s)."""
SURPLUS_TOP_K = 32
"""Surplus agents sample from so many most likely motion tokens if ``top`` is 0."""
FRESH_TOKENS = 2
"""An agent that came into view at most so many token steps ago is fresh: it is still about
where agents come into view."""


@torch.no_grad()
def close_population_loop(
    network: Network,
    batch: Batch,
    top: int,
    seed: int,
    latent_rate_scale: float = 1.0,
    recovery: Recovery = WHOLE_RECOVERY,
    own_share: float = 0.0,
) -> Batch:
    """Simulate a batch with the insertions and removals of the network itself.

    Args:
        network: The network, with insertion; its mode (training or not) is kept.
        batch: Scenes on the network's device: as logged, or with noise if ``top`` is 0.
        top: Most likely motion tokens that those of agents with a logged counterpart are
            chosen from; 0 to move these as the batch has it.
        seed: Of everything that is sampled.
        latent_rate_scale: Latent rates vary so much, beside what the network has learned.
        recovery: How much of a deviation is made good in a token step.
        own_share: Share of the insertions to learn that are simulated as the network
            samples them, not as logged.

    Returns:
        The batch to learn from; it has more rows of agents.

    Raises:
        ValueError: if the network never inserts an agent.
    """
    if network.cells is None:
        raise ValueError(
            "closed loop of insertion and removal with a network that has neither "
            "(model.insertion_and_removal is false); set closed_loop_population=false"
        )
    learning = network.training
    try:
        simulation = _PopulationLoop(
            network, batch, top, seed, latent_rate_scale, recovery, own_share
        )
        for token in range(1, simulation.logged.pose.shape[1]):
            simulation.rates.advance(token)
            simulation.move(token)
            simulation.insert(token)
    finally:
        network.train(learning)
    rows = int(simulation.used.max())
    logged, played = (
        first_rows(agents, rows) for agents in (simulation.logged, simulation.played)
    )
    return targets(batch, logged, played, simulation.turns, network.grid)


class _PopulationLoop(Simulation):
    """A batch of scenes in simulation, in the log's neighbourhood.

    Attributes:
        top: Most likely motion tokens that are chosen from; 0 to follow the batch.
        recovery: How much of a deviation is made good in a token step.
        own_share: Share of the insertions to learn that are as the network samples them.
        off: Whether agents are not as logged [scene, token, agent].
        fresh_until: Last token step at which each agent is fresh [scene, agent].
        used: Rows in use [scene].
        owed: By how much insertions and removals are still to be corrected, by ``Rate``:
            fewer insertions, more removals [scene, 2].
        missing: Who is missing at this token step, in the order of insertion ...
        number: ... and how many of them are to be inserted [scene].
    """

    missing: Tensor
    number: Tensor

    def __init__(
        self,
        network: Network,
        batch: Batch,
        top: int,
        seed: int,
        latent_rate_scale: float,
        recovery: Recovery,
        own_share: float,
    ) -> None:
        """Begin with the first token step as logged."""
        super().__init__(network, batch, seed, latent_rate_scale)
        visible = self.logged.visible
        born = visible.long().argmax(dim=1)  # The first one that is true.
        fresh_until = torch.where(born > 0, born + FRESH_TOKENS, -1)
        self.top = min(top, self.ends.pose.shape[1])
        self.recovery = recovery
        self.own_share = own_share
        self.off = torch.zeros_like(visible)
        self.fresh_until = torch.where(visible.any(dim=1), fresh_until, -1)
        rows = batch.agents.presence.shape[2]
        self.used = torch.full((len(visible),), rows, device=visible.device)
        # Begun anywhere, or all scenes would be corrected at the same token steps.
        self.owed = self.uniforms.draw(len(visible), len(Rate)) - 0.5

    def move(self, token: int) -> None:
        """Move everybody, and remove whom the network removes."""
        logged, played = self.logged, self.played
        said = self.stepper.motion_step(self.memory, self.token_step(token - 1))
        before, seen = played.presence[:, token - 1], played.visible[:, token - 1]
        alive = (before == PRESENT) | (before == INSERTED)
        matched = alive & (logged.presence[:, token] != ABSENT)
        observed = logged.observed[:, token]
        surplus = alive & seen & ~matched
        unasked = (logged.presence[:, token] == INSERTED) & ~alive
        unasked &= (logged.cell[:, token] == NO_CELL) | ~self.asked[:, token, None]
        self.clear(token, ~(matched | unasked))
        self.keep(token, surplus)
        self._label_removals(token, matched, surplus, said.remove_logit)
        who, logits = matched & seen & observed, said.motion_logits
        if self.top:
            near = who, logits, self.top, self.ends, self.recovery
            move_near_log(played, logged, self.off, token, *near)
        self._move_freely(token, surplus, logits)
        known = logged.told[:, token].any(dim=1, keepdim=True)
        leaving = alive & seen & (observed | surplus) & known
        self.remove(token, leaving, said.remove_logit)
        self._encode_cells(token)

    def insert(self, token: int) -> None:
        """Insert agents until the network inserts no more."""
        if self.asked[:, token].any():
            self.missing, self.number = self._to_insert(token)
        super().insert(token)

    def next_insertions(self, token: int, turn: int, active: Tensor) -> NextInsertions:
        """Offer the next missing agent, or a free row; write down what is to be learned."""
        missing = self.missing
        left = self.number[active] > turn
        following = missing[active, min(turn, missing.shape[1] - 1)]
        fresh = left & (self.fresh_until[active, following] >= token)
        self.turns.add[active, token, turn] = left
        self.turns.agent[active, token, turn] = torch.where(fresh, following, NO_AGENT)
        used = self.used[active]
        free = used < self.played.presence.shape[2]
        logged = left & ~self._samples_own(active, free)
        return NextInsertions(torch.where(logged, following, used), logged, logged | free)

    def is_inserted(self, token: int, turn: int, at: tuple[Tensor, Tensor]) -> None:
        """Count the rows in use; agents that the log does not have are not as logged."""
        scene, row = at
        surplus = row == self.used[scene]
        self.turns.count[scene, token] += self.turns.add[scene, token, turn].long()
        self.off[scene[surplus], token, row[surplus]] = True
        self.used[scene] += surplus.long()

    def _samples_own(self, active: Tensor, free: Tensor) -> Tensor:
        """Draw in which scenes the network samples an agent in place of a logged one."""
        if not self.own_share:
            return torch.zeros_like(free)
        return free & (self.uniforms.draw(len(active)) < self.own_share)

    def _move_freely(self, token: int, who: Tensor, logits: Tensor) -> None:
        """Move agents without a counterpart in the log as the network samples."""
        uniform = self.uniforms.draw(*who.shape)
        scene, row = who.nonzero(as_tuple=True)
        top = self.top or SURPLUS_TOP_K
        chosen = choose(logits[scene, row], uniform[scene, row], top)
        self.move_by(token, (scene, row), chosen)
        self.off[scene, token, row] = True

    def _encode_cells(self, token: int) -> None:
        """Find the cells of all who are not to the ego as they were."""
        off, cell = self.off[:, token], self.played.cell
        changed = self.played.observed[:, token] & (off | off[:, EGO, None])
        found = self.cells(self.played.pose[:, token], token)
        cell[:, token] = torch.where(changed, found, cell[:, token])

    def _near(self, agents: Agents, token: int) -> Tensor:
        """Tell which agents are within the radius of the grid [scene, agent]."""
        pose = agents.pose[:, token]
        ego_pose = pose[:, EGO, None].expand_as(pose)
        return within_radius(ego_pose, pose, self.network.grid.radius_m)

    def _excess(self, token: int, *, inserted: bool, near: bool = True) -> Tensor:
        """Count simulated agents around the egos, less those of the log [scene].

        Args:
            token: Token step.
            inserted: Whether those who are inserted at it count.
            near: Whether those within the radius of the grid count, or those beyond it.
        """
        counts = []
        for agents in (self.played, self.logged):
            presence = agents.presence[:, token]
            stays = agents.visible[:, token] & (presence != REMOVED)
            if not inserted:
                stays &= presence != INSERTED
            stays &= self._near(agents, token) == near
            counts.append(stays.sum(dim=1))
        return counts[0] - counts[1]

    def _correction(
        self, rate: Rate, of: Tensor, excess: Tensor, least: Tensor, most: Tensor
    ) -> Tensor:
        """How many fewer insertions, or more removals, to learn [scene]; note the rest.

        Args:
            rate: What is corrected ...
            of: ... and in which scenes.
            excess: Simulated agents, less those of the log [scene].
            least: The least that can be corrected [scene] ...
            most: ... and the most; below zero where some are to be owed.
        """
        self.owed[:, rate] += of * excess / (2 * CORRECTION_TOKENS)
        done = of * self.owed[:, rate].round().long().clamp(least, most)
        self.owed[:, rate] -= done
        return done

    def _label_removals(
        self, token: int, matched: Tensor, surplus: Tensor, logit: Tensor | None
    ) -> None:
        """Say who is to be removed [scene, agent]: as many as the log removes.

        All others are to stay, the surplus too. Were nothing learned of those, as many
        removals would be too few: the network removes some agents before the log does.
        """
        removal, told = self.played.removal[:, token], self.logged.told[:, token]
        known = told.any(dim=1, keepdim=True)
        self.played.told[:, token] = told | (known & surplus)
        if logit is None:
            return
        near, logged_near = (
            self._near(agents, token - 1) for agents in (self.played, self.logged)
        )
        leaving = matched & removal & near
        gone = (self.logged.removal[:, token] & told & ~matched & logged_near).sum(dim=1)
        more = gone + self._correction(
            Rate.REMOVAL,
            known[:, 0],
            self._excess(token - 1, inserted=True),
            -gone - leaving.sum(dim=1),
            (surplus & near).sum(dim=1) - gone,
        )
        uniform = self.uniforms.draw(*logit.shape).clamp(min=LEAST_UNIFORM)
        # The first ones of these are a sample without replacement (Gumbel's trick).
        readiness = logit - (-uniform.log()).log().to(logit)
        removal &= ~(_first(-readiness.masked_fill(~leaving, torch.inf), -more) & leaving)
        far = self._excess(token - 1, inserted=True, near=False) * known[:, 0]
        for who, count in ((surplus & near, more), (surplus & ~near, far)):
            removal |= _first(readiness.masked_fill(~who, -torch.inf), count) & who

    def _to_insert(self, token: int) -> tuple[Tensor, Tensor]:
        """Agents to insert [scene, agent] in the insertion order, and their number."""
        logged, played = self.logged, self.played
        pose, presence = logged.pose[:, token], logged.presence[:, token]
        missing = logged.visible[:, token] & (presence != REMOVED)
        missing &= self.asked[:, token, None] & (played.presence[:, token] == ABSENT)
        missing[:, EGO] = False
        cell = self.cells(pose, token)
        missing &= cell != NO_CELL
        played.cell[:, token] = torch.where(missing, cell, played.cell[:, token])
        new = (missing & (presence == INSERTED)).sum(dim=1)
        missing &= ~self._taken(token, missing)
        fewer = self._correction(
            Rate.INSERTION,
            self.asked[:, token],
            self._excess(token, inserted=False),
            new - missing.sum(dim=1),
            new,
        )
        number = new - fewer
        latest = self.fresh_until.float().masked_fill(~missing, -torch.inf)
        missing &= _first(latest, number)
        flat, ego_pose = pose.flatten(0, 1), played.pose[:, token, EGO, None]
        key = insertion_key(
            flat.numpy(force=True),
            ego_pose.expand_as(pose).flatten(0, 1).numpy(force=True),
            self.network.grid_settings.insertion_order,
        )
        sorted_by = torch.from_numpy(key).to(pose).view(missing.shape)
        sorted_by = sorted_by.masked_fill(~missing, torch.inf)
        return sorted_by.argsort(dim=1, stable=True), number

    def _taken(self, token: int, missing: Tensor) -> Tensor:
        """Mark the missing agents whose logged boxes overlap those of simulated ones.

        Pedestrians may overlap pedestrians, as in logs.
        """
        logged, played = self.logged, self.played
        presence = played.presence[:, token]
        there = played.observed[:, token] & (presence != ABSENT) & (presence != REMOVED)
        scene, row = missing.nonzero(as_tuple=True)
        place, other = there[scene].nonzero(as_tuple=True)
        at, own, walks = scene[place], row[place], AgentType.PEDESTRIAN
        boxes = (
            logged.pose[at, token, own],
            logged.size_lwh_m[at, own, :2],
            played.pose[at, token, other],
            played.size_lwh_m[at, other, :2],
        )
        overlaps = boxes_overlap(*(each.numpy(force=True) for each in boxes))
        taken = torch.from_numpy(overlaps).to(missing.device)
        taken &= (logged.agent_type[at, own] != walks) | (
            played.agent_type[at, other] != walks
        )
        found = torch.zeros_like(missing)
        found[at[taken], own[taken]] = True
        return found


def _first(values: Tensor, count: Tensor) -> Tensor:
    """Mark the ``count`` [scene] largest values [scene, agent]; ties by position."""
    order = values.argsort(dim=1, descending=True, stable=True)
    return order.argsort(dim=1) < count[:, None]
