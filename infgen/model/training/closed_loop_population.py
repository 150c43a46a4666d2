"""Closed-loop fine-tuning of insertion and removal: the network's own population.

``closed_loop`` keeps who is there as the log has it. Here the network itself inserts and
removes agents while the scene is simulated, and learns from the state that it gets into:

- At every token step each agent is removed with the probability that the network gives it,
  and at every insertion turn one more is inserted with the probability that it gives.
- An agent of the log that is not simulated is *missing*; one that is simulated but not, or
  no longer, in the log is *surplus*. The *excess* is the number of the ones less the other.
- As many insertions and removals are to be learned as the log has in this token step,
  corrected by a share of the excess: half of the correction by insertions, half by
  removals, so that in the mean the flow is that of the log. To be inserted are missing
  agents, those first that came into view last; to be removed are those whom the log
  removes, and of the surplus those whom the network is most ready to remove.
- An insertion that the network makes is that of the next agent to be inserted, at its
  logged pose; or of one that it samples, and then nothing is learned of later turns.

To remove all surplus and to insert all missing agents at once, the obvious targets, would
teach several times the flow of the log: it cannot be seen who is surplus, so all agents
would have to be removed at the rate at which surplus ones are found among them.

Agents with a logged counterpart move as in ``closed_loop``, or as the batch has it; surplus
ones move as the network samples, and teach no motion.
"""

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from infgen.model.batching.batch import Agents, Batch
from infgen.model.batching.padding import NOBODY
from infgen.model.batching.tensors import map_tensors
from infgen.model.long_memory import count_around
from infgen.model.network import EGO, Network
from infgen.model.relations import Rows
from infgen.model.step_memory import Insertions as StepInsertions
from infgen.model.step_memory import StepMemory
from infgen.model.stepping import Stepper
from infgen.model.token_step import TokenStep
from infgen.model.training.closed_loop import move_near_log, token_step_at
from infgen.model.training.nearest_tokens import MotionTokenEnds, to_world
from infgen.model.training.own_choices import (
    InsertedAgent,
    UniformNumbers,
    choose_among,
    sample_agent,
)
from infgen.model.training.population_targets import InsertionTurns, targets
from infgen.tokens.grid import encode_cell, to_grid
from infgen.tokens.insertion import insertion_key
from infgen.tokens.scene_tokens import (
    FIRST_MOTION_TOKEN,
    NO_CELL,
    NO_MOTION_TOKEN,
    Presence,
)

SURPLUS_ROWS = 16
"""Surplus agents that the network may insert into one scene; it inserts no more then."""
CORRECTION_TOKENS = 6
"""The excess is corrected in about so many token steps (3 s)."""
SURPLUS_TOP_K = 32
"""Surplus agents sample from so many most likely motion tokens if ``top`` is 0."""
FRESH_TOKENS = 2
"""An agent that came into view at most so many token steps ago is fresh: it is still about
where agents come into view."""
ALL_STEPS = 31
"""Validity pattern of an agent that is seen at all steps of a token step."""
ABSENT, PRESENT, INSERTED, REMOVED = (int(each) for each in Presence)


@torch.no_grad()
def close_population_loop(network: Network, batch: Batch, top: int, seed: int) -> Batch:
    """Simulate a batch with the insertions and removals of the network itself.

    Args:
        network: The network, with insertion; its mode (training or not) is kept.
        batch: Scenes on the network's device: as logged, or with noise if ``top`` is 0.
        top: Most likely motion tokens that those of agents with a logged counterpart are
            chosen from; 0 to move these as the batch has it.
        seed: Of everything that is sampled.

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
        simulation = _Simulation.begin(network, batch, top, seed)
        for token in range(1, simulation.logged.pose.shape[1]):
            simulation.move(token)
            simulation.insert(token)
    finally:
        network.train(learning)
    return targets(
        batch, simulation.logged, simulation.played, simulation.turns, network.grid
    )


@dataclass(slots=True)
class _Simulation:
    """A batch of scenes in simulation.

    Attributes:
        network: The network ...
        stepper: ... evaluated step by step.
        memory: Its past.
        ends: Where motion tokens end.
        top: Most likely motion tokens that are chosen from; 0 to follow the batch.
        uniforms: Random numbers.
        logged: Agents of the log, followed by free rows for surplus ones.
        asked: Token steps with insertion queries [scene, token].
        played: The same agents as simulated so far.
        off: Whether they are not as logged [scene, token, agent].
        turns: Insertions so far.
        fresh_until: Last token step at which each agent is fresh [scene, agent].
        used: Rows in use [scene].
    """

    network: Network
    stepper: Stepper
    memory: StepMemory
    ends: MotionTokenEnds
    top: int
    uniforms: UniformNumbers
    logged: Agents
    asked: Tensor
    played: Agents
    off: Tensor
    turns: InsertionTurns
    fresh_until: Tensor
    used: Tensor

    @classmethod
    def begin(cls, network: Network, batch: Batch, top: int, seed: int) -> "_Simulation":
        """Begin with the first token step as logged."""
        stepper, vocabulary = Stepper(network), network.motion_vocabulary()
        logged = _with_rows(batch.agents, SURPLUS_ROWS)
        scenes, tokens, rows = logged.presence.shape
        device = logged.pose.device
        visible = logged.visible
        born = visible.long().argmax(dim=1)  # The first one that is true.
        fresh_until = torch.where(born > 0, born + FRESH_TOKENS, -1)
        slots = network.settings.max_insertions + 1
        return cls(
            network=network,
            stepper=stepper,
            memory=stepper.begin(batch.roads, torch.arange(scenes, device=device), rows),
            ends=MotionTokenEnds.of(vocabulary, device),
            top=min(top, vocabulary.num_motion_tokens),
            uniforms=UniformNumbers(seed, device),
            logged=logged,
            asked=batch.entries.asked,
            played=map_tensors(logged, Tensor.clone),
            off=torch.zeros_like(visible),
            turns=InsertionTurns.none(scenes, tokens, slots, device),
            fresh_until=torch.where(visible.any(dim=1), fresh_until, -1),
            used=torch.full((scenes,), rows - SURPLUS_ROWS, device=device),
        )

    def move(self, token: int) -> None:
        """Move everybody, and remove whom the network removes."""
        logged, played = self.logged, self.played
        said = self.stepper.motion_step(self.memory, self._token_step(token - 1))
        before, seen = played.presence[:, token - 1], played.visible[:, token - 1]
        alive = (before == PRESENT) | (before == INSERTED)
        matched = alive & (logged.presence[:, token] != ABSENT)
        observed = logged.observed[:, token]
        surplus = alive & seen & ~matched
        unasked = (logged.presence[:, token] == INSERTED) & ~alive
        unasked &= (logged.cell[:, token] == NO_CELL) | ~self.asked[:, token, None]
        self._clear(token, ~(matched | unasked))
        played.observed[:, token] |= surplus
        played.pattern[:, token].masked_fill_(surplus, ALL_STEPS)
        played.presence[:, token].masked_fill_(surplus, PRESENT)
        self._label_removals(token, matched, surplus, said.remove_logit)
        who, logits = matched & seen & observed, said.motion_logits
        if self.top:
            near = who, logits, self.top, self.ends
            move_near_log(played, logged, self.off, token, *near)
        self._move_freely(token, surplus, logits)
        self._remove(token, alive & seen & (observed | surplus), said.remove_logit)
        self._encode_cells(token)

    def insert(self, token: int) -> None:
        """Insert agents until the network inserts no more."""
        if not self.asked[:, token].any():
            return
        missing, number = self._to_insert(token)
        active = self.asked[:, token].nonzero()[:, 0]
        entries = self.stepper.entry_begin(self.memory, self._token_step(token))
        entries = entries.take(active)
        last = self.turns.add.shape[2] - 1
        for turn in range(last + 1):
            query = self.stepper.entry_query(entries)
            left = number[active] > turn
            following = missing[active, min(turn, missing.shape[1] - 1)]
            fresh = left & (self.fresh_until[active, following] >= token)
            self.turns.add[active, token, turn] = left
            self.turns.agent[active, token, turn] = torch.where(fresh, following, NOBODY)
            room = left | (self.used[active] < self.played.presence.shape[2])
            add = self.uniforms.draw(len(active)) < torch.sigmoid(query.add_logit.double())
            places = (add & room).nonzero()[:, 0]
            if turn == last or not len(places):
                return
            active, query = active[places], query.take(places)
            entries, left, following = entries.take(places), left[places], following[places]
            invented = sample_agent(
                self.stepper, entries, query, self.uniforms, self.network.grid
            )
            row = torch.where(left, following, self.used[active])
            self._place(token, turn, (active, row), left, invented)
            self.used[active] += (~left).long()
            self.turns.count[active, token] += left.long()
            entries = self._show(entries, token, (active, row))

    def _token_step(self, token: int) -> TokenStep:
        return token_step_at(self.played, token)

    def _clear(self, token: int, who: Tensor) -> None:
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

    def _move_freely(self, token: int, who: Tensor, logits: Tensor) -> None:
        """Move agents without a counterpart in the log as the network samples."""
        played, uniform = self.played, self.uniforms.draw(*who.shape)
        scene, row = who.nonzero(as_tuple=True)
        top = self.top or SURPLUS_TOP_K
        chosen = choose_among(logits[scene, row], uniform[scene, row], top)
        path = self.ends.pose[played.agent_type[scene, row], chosen]
        before = played.pose[scene, token - 1, row]
        played.motion_token[scene, token, row] = chosen
        played.pose[scene, token, row] = to_world(path, before)
        self.off[scene, token, row] = True

    def _remove(self, token: int, who: Tensor, logit: Tensor | None) -> None:
        """Remove some agents [scene, agent] as the network samples."""
        uniform = self.uniforms.draw(*who.shape)
        if logit is None:
            return
        who = who & self.logged.told[:, token].any(dim=1, keepdim=True)
        who[:, EGO] = False
        leaves = uniform < torch.sigmoid(logit.double())
        stays = torch.where(leaves, REMOVED, PRESENT)
        presence = self.played.presence
        presence[:, token] = torch.where(who, stays, presence[:, token])

    def _encode_cells(self, token: int) -> None:
        """Find the cells of all who are not to the ego as they were."""
        off, cell = self.off[:, token], self.played.cell
        changed = self.played.observed[:, token] & (off | off[:, EGO, None])
        found = self._cells(self.played.pose[:, token], token)
        cell[:, token] = torch.where(changed, found, cell[:, token])

    def _cells(self, pose: Tensor, token: int) -> Tensor:
        ego_pose = self.played.pose[:, token, EGO, None].numpy(force=True)
        found = encode_cell(
            to_grid(pose[..., :2].numpy(force=True), ego_pose), self.network.grid
        )
        return torch.from_numpy(found).to(self.played.cell)

    def _excess(self, token: int, *, inserted: bool) -> Tensor:
        """Count simulated agents around the egos, less those of the log [scene].

        Args:
            token: Token step.
            inserted: Whether those who are inserted at it count.
        """
        radius_m, counts = self.network.grid.radius_m, []
        for agents in (self.played, self.logged):
            presence, pose = agents.presence[:, token], agents.pose[:, token]
            stays = agents.visible[:, token] & (presence != REMOVED)
            if not inserted:
                stays &= presence != INSERTED
            counts.append(count_around(pose[:, EGO], pose, stays, radius_m))
        return counts[0] - counts[1]

    def _correction(self, excess: Tensor) -> Tensor:
        """How many fewer insertions, and more removals, to learn [scene]."""
        wanted = excess / (2 * CORRECTION_TOKENS)
        return (wanted + self.uniforms.draw(len(excess)).to(wanted)).floor().long()

    def _label_removals(
        self, token: int, matched: Tensor, surplus: Tensor, logit: Tensor | None
    ) -> None:
        """Say who is to be removed [scene, agent]; of other surplus agents nothing."""
        removal, told = self.played.removal[:, token], self.logged.told[:, token]
        known = told.any(dim=1, keepdim=True)
        self.played.told[:, token] = told & ~surplus
        if logit is None:
            return
        more = self._correction(self._excess(token - 1, inserted=True))
        readiness = logit.masked_fill(~surplus, -torch.inf)
        ready = _first(readiness, more) & surplus
        removal |= ready
        self.played.told[:, token] |= known & ready
        leaving = matched & removal
        reluctance = (-logit).masked_fill(~leaving, -torch.inf)
        removal &= ~(_first(reluctance, -more) & leaving)

    def _to_insert(self, token: int) -> tuple[Tensor, Tensor]:
        """Agents to insert [scene, agent] in the insertion order, and their number."""
        logged, played = self.logged, self.played
        pose, presence = logged.pose[:, token], logged.presence[:, token]
        missing = logged.visible[:, token] & (presence != REMOVED)
        missing &= self.asked[:, token, None] & (played.presence[:, token] == ABSENT)
        missing[:, EGO] = False
        cell = self._cells(pose, token)
        missing &= cell != NO_CELL
        played.cell[:, token] = torch.where(missing, cell, played.cell[:, token])
        fewer = self._correction(self._excess(token, inserted=False))
        number = (missing & (presence == INSERTED)).sum(dim=1) - fewer
        number = number.clamp(min=0).minimum(missing.sum(dim=1))
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

    def _place(
        self,
        token: int,
        turn: int,
        at: tuple[Tensor, Tensor],
        matched: Tensor,
        invented: InsertedAgent,
    ) -> None:
        """Write inserted agents: missing ones as logged, others as they were sampled."""
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
            values[here] = torch.where(matched, own, other.to(own))
        pose = torch.where(matched[:, None], logged.pose[here], invented.pose)
        played.pose[here] = pose
        new = scene[~matched], row[~matched]
        played.agent_type[new] = invented.agent_type[~matched]
        played.size_lwh_m[new] = invented.size_lwh_m[~matched]
        self.off[new[0], token, new[1]] = True

    def _show(
        self, entries: StepInsertions, token: int, at: tuple[Tensor, Tensor]
    ) -> StepInsertions:
        """Show the network who has been inserted."""
        fresh = torch.zeros_like(self.off[:, token])
        fresh[at] = True
        return self.stepper.entry_add(entries, self._token_step(token), Rows.where(fresh))


def _first(values: Tensor, count: Tensor) -> Tensor:
    """Mark the ``count`` [scene] largest values [scene, agent]; ties by position."""
    order = values.argsort(dim=1, descending=True, stable=True)
    return order.argsort(dim=1) < count[:, None]


def _with_rows(agents: Agents, more: int) -> Agents:
    """Append free rows for agents."""
    nothing = {"motion_token": NO_MOTION_TOKEN, "label": NO_MOTION_TOKEN}
    nothing |= {"cell": NO_CELL, "turn": -1}
    padded = {}
    for each in fields(agents):
        values, fill = getattr(agents, each.name), nothing.get(each.name, 0)
        if each.name in ("pose", "size_lwh_m"):
            padded[each.name] = pad(values, (0, 0, 0, more), value=fill)
        else:
            padded[each.name] = pad(values, (0, more), value=fill)
    return replace(agents, **padded)
