"""Batches that the network simulates itself, with its own insertions and removals.

What ``closed_loop_population`` and ``policy_gradient`` share: the state of a batch in
simulation, one token step of it, and the insertion turns. They differ in who moves how, in
whose row an inserted agent takes, and in what is learned.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from infgen.model.batching.batch import Agents, Batch
from infgen.model.batching.frames import to_world
from infgen.model.batching.tensors import map_tensors
from infgen.model.latent_rates import Rate
from infgen.model.network import Network
from infgen.model.relations import Rows
from infgen.model.sampling import sample_event
from infgen.model.step_memory import Insertions as StepInsertions
from infgen.model.stepping import Stepper
from infgen.model.token_step import PositionOutputs, TokenStep
from infgen.model.training.closed_loop import token_step_at
from infgen.model.training.nearest_tokens import MotionTokenEnds
from infgen.model.training.own_choices import InsertedAgent, UniformNumbers, sample_agent
from infgen.model.training.population_targets import InsertionTurns
from infgen.model.training.rate_samples import RateSamples
from infgen.tokens.grid import encode_cell, to_grid
from infgen.tokens.scene_tokens import (
    EGO,
    FIRST_MOTION_TOKEN,
    NO_CELL,
    NO_MOTION_TOKEN,
    Presence,
)

FREE_ROWS_PER_TOKEN = 2
"""Rows appended to every scene for each token step, for agents that only the network
inserts. If they ran out, no more agents would be inserted, and closed loop would teach to
insert more than the log does: 62 token steps of towns take up to 100 of them."""
VECTORS = ("pose", "size_lwh_m")
"""What of agents has a further dimension behind that of agents."""
ALL_STEPS = 31
"""Validity pattern of an agent that is seen at all steps of a token step."""
ABSENT, PRESENT, INSERTED, REMOVED = (int(each) for each in Presence)


@dataclass(frozen=True, slots=True)
class NextInsertions:
    """Whom the network may insert next, of each scene that is asked.

    Attributes:
        row: Row that the agent would take [active].
        logged: Whether it is the agent of that row in the log, at its logged pose; else it
            is as the network samples it.
        room: Whether there is such a row.
    """

    row: Tensor
    logged: Tensor
    room: Tensor

    def take(self, places: Tensor) -> "NextInsertions":
        """Go on with some scenes only."""
        return NextInsertions(self.row[places], self.logged[places], self.room[places])


class Simulation(ABC):
    """A batch of scenes, or several copies of it, in simulation.

    Attributes:
        network: The network ...
        stepper: ... evaluated step by step.
        memory: Its past.
        ends: Where motion tokens end.
        uniforms: Random numbers.
        rates: Latent rates.
        logged: Agents of the log, followed by free rows; copy after copy.
        asked: Token steps with insertion queries [scene, token].
        played: The same agents as simulated so far.
        turns: Insertions so far.
    """

    def __init__(
        self,
        network: Network,
        batch: Batch,
        seed: int,
        latent_rate_scale: float,
        copies: int = 1,
    ) -> None:
        """Begin with the first token step as logged."""
        agents = map_tensors(batch.agents, lambda x: x.repeat(copies, *[1] * (x.dim() - 1)))
        device, scenes = agents.pose.device, len(batch.agents.pose)
        self.network, self.stepper = network, Stepper(network)
        self.logged = _with_rows(agents, FREE_ROWS_PER_TOKEN * agents.presence.shape[1])
        rollouts, tokens, rows = self.logged.presence.shape
        scene = torch.arange(scenes, device=device).repeat(copies)
        self.memory = self.stepper.begin(batch.roads, scene, rows)
        self.ends = MotionTokenEnds.of(network.motion_vocabulary(), device)
        self.uniforms = UniformNumbers(seed, device)
        process = None
        if network.rates is not None and latent_rate_scale:
            process = network.rates().scaled(latent_rate_scale)
        self.rates = RateSamples(process, self.logged.presence, self.uniforms)
        self.asked = batch.entries.asked.repeat(copies, 1)
        self.played = map_tensors(self.logged, Tensor.clone)
        slots = network.settings.max_insertions + 1
        self.turns = InsertionTurns.none(rollouts, tokens, slots, device)

    @abstractmethod
    def next_insertions(self, token: int, turn: int, active: Tensor) -> NextInsertions:
        """Say whom the network may insert at a turn, in the scenes ``active``."""

    @abstractmethod
    def is_inserted(self, token: int, turn: int, at: tuple[Tensor, Tensor]) -> None:
        """Count agents that have been inserted, at scenes and rows ``at``."""

    def insert(self, token: int) -> None:
        """Insert agents until the network inserts no more."""
        if not self.asked[:, token].any():
            return
        active = self.asked[:, token].nonzero()[:, 0]
        entries = self.stepper.entry_begin(self.memory, self.token_step(token))
        entries = entries.take(active)
        last = self.turns.add.shape[2] - 1
        for turn in range(last + 1):
            query = self.stepper.entry_query(entries)
            following = self.next_insertions(token, turn, active)
            added = self.rates.of(Rate.INSERTION, token)[active]
            add = sample_event(query.add_logit, self.uniforms.draw(len(active)), added)
            places = (add & following.room).nonzero()[:, 0]
            if turn == last or not len(places):
                return
            active, query = active[places], query.take(places)
            entries, following = entries.take(places), following.take(places)
            invented, free = self.sample_agent(token, active, entries, query)
            if free is not None and not free.all():  # The others insert no more.
                places = free.nonzero()[:, 0]
                if not len(places):
                    return
                active, invented = active[places], invented.take(places)
                entries, following = entries.take(places), following.take(places)
            at = active, following.row
            self._place(token, turn, at, following.logged, invented)
            self.is_inserted(token, turn, at)
            entries = self._show(entries, token, at)

    def sample_agent(
        self, token: int, active: Tensor, entries: StepInsertions, query: PositionOutputs
    ) -> tuple[InsertedAgent, Tensor | None]:
        """Sample agents for the scenes ``active``, and tell which may be inserted (all)."""
        grid = self.network.grid
        return sample_agent(self.stepper, entries, query, self.uniforms, grid), None

    def token_step(self, token: int) -> TokenStep:
        """Take the agents of one token step."""
        return token_step_at(self.played, token)

    def clear(self, token: int, who: Tensor) -> None:
        """Free some rows [scene, agent]."""
        played = self.played
        for values, nothing in (
            (played.presence, ABSENT),
            (played.observed, False),
            (played.motion_token, NO_MOTION_TOKEN),
            (played.label, NO_MOTION_TOKEN),
            (played.pattern, 0),
            (played.cell, NO_CELL),
            (played.turn, -1),
            (played.removal, False),
        ):
            values[:, token].masked_fill_(who, nothing)

    def keep(self, token: int, who: Tensor) -> None:
        """Let some agents [scene, agent] be there and seen, whatever the log says."""
        self.played.observed[:, token] |= who
        self.played.pattern[:, token].masked_fill_(who, ALL_STEPS)
        self.played.presence[:, token].masked_fill_(who, PRESENT)

    def move_by(self, token: int, at: tuple[Tensor, Tensor], motion_token: Tensor) -> None:
        """Move the agents ``at`` some scenes and rows by motion tokens [row]."""
        (scene, row), played = at, self.played
        path = self.ends.pose[played.agent_type[scene, row], motion_token]
        before = played.pose[scene, token - 1, row]
        played.motion_token[scene, token, row] = motion_token
        played.pose[scene, token, row] = to_world(path, before)

    def remove(self, token: int, who: Tensor, logit: Tensor | None) -> None:
        """Remove some agents [scene, agent] as the network samples; never an ego."""
        uniform = self.uniforms.draw(*who.shape)
        if logit is None:
            return
        added = self.rates.of(Rate.REMOVAL, token)[:, None]
        leaves = sample_event(logit, uniform, added)
        leaves[:, EGO] = False
        stays = torch.where(leaves, REMOVED, PRESENT)
        presence = self.played.presence
        presence[:, token] = torch.where(who, stays, presence[:, token])

    def cells(self, pose: Tensor, token: int) -> Tensor:
        """Find the cells of poses [scene, agent, 3] around the egos."""
        ego_pose = self.played.pose[:, token, EGO, None].numpy(force=True)
        found = encode_cell(
            to_grid(pose[..., :2].numpy(force=True), ego_pose), self.network.grid
        )
        return torch.from_numpy(found).to(self.played.cell)

    def _place(
        self,
        token: int,
        turn: int,
        at: tuple[Tensor, Tensor],
        known: Tensor,
        invented: InsertedAgent,
    ) -> None:
        """Write inserted agents: known ones as logged, others as they were sampled."""
        logged, played = self.logged, self.played
        scene, row = at
        here = scene, token, row
        played.presence[here] = INSERTED
        played.motion_token[here] = FIRST_MOTION_TOKEN
        played.label[here] = FIRST_MOTION_TOKEN
        played.turn[here] = turn
        for values, own, other in (
            (played.pattern, logged.pattern[here], torch.tensor(ALL_STEPS)),
            (played.cell, played.cell[here], invented.cell),
        ):
            values[here] = torch.where(known, own, other.to(own))
        pose = torch.where(known[:, None], logged.pose[here], invented.pose)
        played.pose[here] = pose
        new = scene[~known], row[~known]
        played.agent_type[new] = invented.agent_type[~known]
        played.size_lwh_m[new] = invented.size_lwh_m[~known]

    def _show(
        self, entries: StepInsertions, token: int, at: tuple[Tensor, Tensor]
    ) -> StepInsertions:
        """Show the network who has been inserted."""
        fresh = torch.zeros_like(self.played.observed[:, token])
        fresh[at] = True
        return self.stepper.entry_add(entries, self.token_step(token), Rows.where(fresh))


def first_rows(agents: Agents, rows: int) -> Agents:
    """Leave out all agents but those of the first rows."""
    kept = {
        each.name: getattr(agents, each.name).narrow(-1 - (each.name in VECTORS), 0, rows)
        for each in fields(agents)
    }
    return replace(agents, **kept)


def _with_rows(agents: Agents, more: int) -> Agents:
    """Append free rows for agents."""
    nothing = {"motion_token": NO_MOTION_TOKEN, "label": NO_MOTION_TOKEN}
    nothing |= {"cell": NO_CELL, "turn": -1}
    padded = {}
    for each in fields(agents):
        values, fill = getattr(agents, each.name), nothing.get(each.name, 0)
        if each.name in VECTORS:
            padded[each.name] = pad(values, (0, 0, 0, more), value=fill)
        else:
            padded[each.name] = pad(values, (0, more), value=fill)
    return replace(agents, **padded)
