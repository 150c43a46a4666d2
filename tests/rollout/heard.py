"""The slow, obvious way: all that the engine said, computed again from what was played.

A ``Listening`` stepper keeps what it is shown and what it says. ``recompute`` writes the
played rollouts down as a training batch, one agent per life, and passes it through
``Network.forward``: every column anew, nothing remembered.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from infgen.model.agent_embedding import KINDS
from infgen.model.batching.batch import Agents, Batch, Details, Insertions, collate_maps
from infgen.model.batching.insertion_targets import OUTSIDE
from infgen.model.insertion.detail_query import InsertionDetails
from infgen.model.logits import DetailOutputs, InsertionOutputs, MotionOutputs
from infgen.model.stepping import Stepper
from infgen.model.token_step import MotionStep, PositionOutputs, TokenStep
from infgen.rollout.population import place_logged_agents
from infgen.rollout.recording import NO_AGENT
from infgen.rollout.session import Session
from infgen.tokens.scene_tokens import NO_CELL, NO_MOTION_TOKEN, Presence

QUERY_LOGITS = ("add_logit", "position_logits", "position_m")
DETAIL_LOGITS = (
    "agent_type_logits",
    "size_lwh_m",
    "heading_logits",
    "turned_rad",
    "offset_m",
)
MOTION_LOGITS = ("motion_logits", "remove_logit", "pattern_logits")


@dataclass(frozen=True)
class RequestOptions:
    """Rollouts that queried an insertion at a token step, and the turn of each.

    ``cell`` and ``position_m`` are where in them, if it was asked who enters.
    """

    token: int
    rollout: Tensor
    turn: Tensor
    said: PositionOutputs | InsertionDetails
    cell: Tensor | None = None
    position_m: Tensor | None = None


class Listening(Stepper):
    """A stepper that keeps all it is shown, and all it says."""

    def __init__(self, network):
        super().__init__(network)
        self.columns: list[TokenStep] = []
        self.motion: list[MotionStep] = []
        self.queries: list[RequestOptions] = []
        self.details: list[RequestOptions] = []

    def motion_step(self, memory, token_step, rows=None):
        said = super().motion_step(memory, token_step, rows)
        self.columns.append(token_step)
        self.motion.append(said)
        return said

    def entry_query(self, entries):
        said = super().entry_query(entries)
        # A copy: logits of taken cells are masked in place.
        everyone = torch.arange(len(said.add_logit))
        self.queries.append(asked(entries, said.take(everyone)))
        return said

    def entry_details(self, entries, cell, position_m=None):
        said = super().entry_details(entries, cell, position_m)
        for some in once_each(entries.rollout):
            where = [None if one is None else one[some] for one in (cell, position_m)]
            self.details.append(asked(entries.take(some), _of(said, some), *where))
        return said


def once_each(rollout):
    """Split places so that each part names a rollout once: attempts are made by fours."""
    rank = (rollout[:, None] == rollout).tril(-1).sum(dim=1)
    return [(rank == at).nonzero()[:, 0] for at in range(int(rank.max()) + 1)]


def _of(said, places):
    """Take some of the answers."""
    values = {one.name: getattr(said, one.name) for one in fields(said)}
    kept = {
        name: value[places] for name, value in values.items() if isinstance(value, Tensor)
    }
    return replace(said, **kept)


def asked(entries, said, *where):
    """Note who asked; inserted agents so far tell the turn."""
    presence = entries.token_step.presence[entries.rollout]
    turn = (presence == Presence.INSERTED).sum(dim=1)
    return RequestOptions(entries.token, entries.rollout, turn, said, *where)


@dataclass(frozen=True)
class Played:
    """Rollouts that were listened to.

    Attributes:
        starts: What they continue.
        heard: The stepper that played them.
        agent: Agent of the recomputed batch in each row, or -1 [token, rollout, row].
    """

    starts: list
    heard: Listening
    agent: np.ndarray

    @property
    def tokens(self):
        """Token steps whose column was played to the end."""
        return len(self.heard.columns)

    @property
    def now(self):
        return self.starts[0].history.now

    @property
    def presence(self):
        """``Presence`` [token, rollout, row]."""
        return torch.stack(
            [token_step.presence for token_step in self.heard.columns]
        ).numpy()

    @property
    def queries(self):
        return [one for one in self.heard.queries if one.token < self.tokens]

    @property
    def details(self):
        return [one for one in self.heard.details if one.token < self.tokens]


def play(simulator, starts, half_seconds):
    """Play so many token steps, each with its inserted agents."""
    session = Session(simulator, starts)
    lives = [session.population.agent_number] * (session.token + 1)
    for _ in range(half_seconds):
        session.step()
        lives.append(session.population.agent_number)
    session.step()  # Only now does the network see the agents inserted last.
    return Played(starts, simulator.stepper, _agents_of(starts, np.stack(lives)))


def _agents_of(starts, lives):
    """Number agents: those of the history by their rows, the others by their lives."""
    settled = place_logged_agents(starts, lives.shape[2])[-1].agent_number
    agent = lives.copy()
    for at, start in enumerate(starts):
        logged = np.flatnonzero(settled[at] != NO_AGENT)
        number = np.arange(max(lives[:, at].max() + 1, start.history.num_agents))
        number[settled[at, logged]] = logged
        agent[:, at] = np.where(lives[:, at] == NO_AGENT, -1, number[lives[:, at]])
    return agent


def recompute(network, played):
    """All logits of a plain pass over everything that was played: ``(batch, outputs)``."""
    histories = [start.history for start in played.starts]
    batch = Batch(
        scenario_ids=tuple(history.scenario_id for history in histories),
        agents=_agents(played),
        roads=collate_maps(histories, 10_000),
        entries=_entries(played),
        details=_details(network, played),
    )
    with torch.inference_mode():
        return batch, network.eval()(batch)


def _agents(played):
    columns, agent = played.heard.columns, torch.from_numpy(played.agent).long()
    tokens, rollouts, _ = agent.shape
    count = int(agent.max()) + 1
    token, rollout, row = (agent >= 0).nonzero(as_tuple=True)
    number = agent[token, rollout, row]

    def told(name, fill):
        values = torch.stack([getattr(token_step, name) for token_step in columns])
        shape = (rollouts, tokens, count, *values.shape[3:])
        filled = torch.full(shape, fill, dtype=values.dtype)
        filled[rollout, token, number] = values[token, rollout, row]
        return filled

    presence = told("presence", int(Presence.ABSENT))
    return Agents(
        agent_type=told("agent_type", 0).amax(dim=1),
        size_lwh_m=told("size_lwh_m", 0.0).amax(dim=1),
        near=torch.ones((rollouts, count), dtype=torch.bool),
        pose=told("pose", 0.0),
        motion_token=told("motion_token", NO_MOTION_TOKEN),
        label=told("motion_token", NO_MOTION_TOKEN),
        presence=presence,
        observed=told("observed", False),
        pattern=torch.zeros_like(presence),
        cell=told("cell", NO_CELL),
        turn=_turns(presence, played.now),
        removal=torch.zeros_like(presence, dtype=torch.bool),
        told=torch.ones_like(presence, dtype=torch.bool),
    )


def _turns(presence, now):
    """Turn of each agent among those that enter at its token: they are numbered so."""
    entering = presence == Presence.INSERTED
    played = torch.arange(presence.shape[1])[:, None] > now
    turn = torch.where(played, entering.cumsum(dim=-1) - 1, OUTSIDE)
    return torch.where(entering, turn, -1)


def _entries(played):
    """Ask for as many inserted agents at every token step as the engine ever did."""
    shape = (len(played.starts), played.tokens)
    slots = 1 + max((int(one.turn.max()) for one in played.queries), default=0)
    no_agent = torch.full((*shape, slots), NO_AGENT)
    return Insertions(
        asked=(torch.arange(played.tokens) > played.now).expand(shape),
        count=torch.zeros(shape, dtype=torch.int64),
        add=torch.zeros_like(no_agent, dtype=torch.bool),
        agent=no_agent,
        cell=torch.zeros_like(no_agent),
    )


def _details(network, played):
    """Every answer as three agents to describe, one of each kind, that nobody sees."""
    told, kinds = played.details, len(KINDS)
    rollouts = len(played.starts)

    def spread(name, dtype, shape=()):
        filled = torch.zeros((rollouts, len(told), *shape), dtype=dtype)
        for at, one in enumerate(told):
            value = getattr(one, name)
            filled[one.rollout, at] = True if name == "rollout" else value
        return filled.repeat_interleave(kinds, dim=1)

    token, cell = spread("token", torch.int64), spread("cell", torch.int64)
    offset_m = torch.zeros((*token.shape, 2))
    if told and told[0].position_m is not None:
        position_m = spread("position_m", torch.float32, (2,))
        offset_m = position_m - network.details.centre_m[cell]
    present = spread("rollout", torch.bool)
    return Details(
        present=present,
        inserted=torch.zeros_like(present),
        agent=torch.full_like(token, NO_AGENT),
        token=token,
        turn=spread("turn", torch.int64),
        cell=cell,
        agent_type=torch.arange(kinds).repeat(len(told)).expand(rollouts, -1),
        size_lwh_m=torch.ones((*token.shape, 3)),
        heading=torch.zeros_like(token),
        offset_m=offset_m,
        offset=torch.zeros_like(token),
    )


class Gaps:
    """Largest difference of each kind of logit, and how many numbers were compared."""

    def __init__(self, played, batch, outputs):
        self.largest: dict[str, float] = {}
        self.compared: dict[str, int] = {}
        self._motion(played, outputs.motion)
        visible = sum(int(token_step.visible.sum()) for token_step in played.heard.columns)
        assert batch.agents.visible.sum() == visible
        if outputs.entries is not None:
            self._queries(played, outputs.entries)
            self._details(played, outputs.details)

    def _motion(self, played, said: MotionOutputs):
        for token, step in enumerate(played.heard.motion):
            rollout, row = played.heard.columns[token].visible.nonzero(as_tuple=True)
            agent = torch.from_numpy(played.agent[token]).long()[rollout, row]
            number = said.rows.number[rollout, token, agent]
            for name in MOTION_LOGITS:
                heard = getattr(step, name)
                heard = None if heard is None else heard[rollout, row]
                self._take(name, heard, getattr(said, name), number)

    def _queries(self, played, said: InsertionOutputs):
        for one in played.queries:
            number = said.rows.number[one.rollout, one.token]
            for name in QUERY_LOGITS:
                told = getattr(said, name)
                told = None if told is None else told[number, one.turn]
                self._take(name, getattr(one.said, name), told, slice(None))

    def _details(self, played, said: DetailOutputs):
        kinds = torch.arange(len(KINDS))
        for at, one in enumerate(played.details):
            number = said.rows.number[one.rollout[:, None], at * len(KINDS) + kinds]
            for name in DETAIL_LOGITS:
                if name == "heading_logits" and one.said.query is not None:
                    continue  # Given the offset that was sampled.
                told = said.size_log_m.exp() if name == "size_lwh_m" else None
                told = getattr(said, name) if told is None else told
                heard = getattr(one.said, name)
                if name == "agent_type_logits":  # The same whatever kind is given.
                    heard = heard[:, None].expand(-1, len(KINDS), -1)
                self._take(name, heard, told, number)

    def _take(self, name, heard, told, number):
        assert (heard is None) == (told is None), name
        if heard is None or not heard.numel():
            return
        assert torch.isfinite(heard).all(), name
        gap = float((heard - told[number]).abs().max())
        self.largest[name] = max(gap, self.largest.get(name, 0.0))
        self.compared[name] = heard.numel() + self.compared.get(name, 0)
