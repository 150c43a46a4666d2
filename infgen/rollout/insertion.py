"""Insertion of agents in one token step, one agent per query of the network."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from infgen.model.insertion.detail_query import InsertionDetails
from infgen.model.sampling import choose, sample_event
from infgen.model.step_memory import Insertions, StepMemory
from infgen.model.token_step import PositionOutputs
from infgen.rollout.insertion_state import (
    TURN_PURPOSES,
    Attempts,
    InsertionRequest,
    InsertionState,
    TurnNumbers,
)
from infgen.rollout.population import InsertedAgents, Population
from infgen.rollout.random_streams import WORDS, Purpose
from infgen.rollout.simulator import Simulator
from infgen.tokens.grid import Grid, decode_heading, encode_cell

INSIDE = 0.999
"""Inserted agents stay within this share of the grid radius, whatever their offsets."""
FEW_ROLLOUTS = 16
"""A query of so few rollouts costs as much as one of four times as many."""

UniformNumbers = Callable[[Purpose], Tensor]


@dataclass(slots=True)
class _Turns:
    """Insertion turns of a batch: every rollout is at a turn and an attempt of its own.

    So no rollout waits for the rejected positions of another, and the network is queried
    for many rollouts, and several attempts of each, at once. Nothing is computed for
    rollouts that are done. Changes in place.

    Attributes:
        batch: All rollouts.
        entries: The token step as the network sees it, of all rollouts.
        query: Latest logits of their positions, minus infinity for cells that hold an agent
            or were rejected in this turn.
        numbers: Random numbers.
        turn: Agents that each rollout has inserted.
        attempt: Positions rejected in this turn.
    """

    batch: InsertionState
    entries: Insertions
    query: PositionOutputs | None
    numbers: TurnNumbers
    turn: Int64[np.ndarray, " rollout"]
    attempt: Int64[np.ndarray, " rollout"]

    @classmethod
    def of(cls, batch: InsertionState, entries: Insertions, token: int) -> "_Turns":
        """Begin a token step."""
        streams = batch.request.streams
        turn = np.zeros(len(streams), dtype=np.int64)
        numbers = TurnNumbers.of(streams, token)
        return cls(batch, entries, None, numbers, turn, turn.copy())

    def advance(
        self, rollouts: Int64[np.ndarray, " active"]
    ) -> Int64[np.ndarray, " active_"]:
        """Sample positions of every active rollout; return those that go on."""
        turn, attempt = self.turn[rollouts], self.attempt[rollouts]
        self.numbers.draw(rollouts, turn, attempt)
        fresh = attempt == 0
        if fresh.any():
            goes_on = ~fresh
            goes_on[fresh] = self._query(rollouts[fresh])
            rollouts = rollouts[goes_on]
        if not len(rollouts):
            return rollouts
        attempts = self._attempts(rollouts)
        inserted = _sample_agents(self, attempts)
        batch = self.batch
        mask, allowed = batch.request.insertion_mask, inserted.who
        if mask is not None:
            allowed = mask.allows(
                batch.population, inserted, attempts.rollout, batch.circles
            )
        taken = attempts.first(allowed)
        placed, rejected = rollouts[taken >= 0], rollouts[taken < 0]
        if len(placed):
            self._add(placed, inserted.take(taken[taken >= 0]))
        self.turn[placed] += 1
        self.attempt[placed] = 0
        self.attempt[rejected] += attempts.count[taken < 0]
        turns = batch.request.simulator.settings.max_insertions
        ends = (self.turn >= turns) | (self.attempt >= batch.request.attempts)
        return rollouts[~ends[rollouts]]

    def _attempts(self, rollouts: Int64[np.ndarray, " active"]) -> Attempts:
        """Say which attempts are made at once: the first alone, later ones by fours.

        The queries of the network are then fewer and larger. What is sampled is the same:
        every attempt excludes the cells of those before it.
        """
        turn, attempt = self.turn[rollouts], self.attempt[rollouts]
        left = self.batch.request.attempts - attempt
        alone = (attempt == 0) & (len(rollouts) > FEW_ROLLOUTS)
        count = np.minimum(np.where(alone, 1, WORDS - attempt % WORDS), left)
        of = np.repeat(np.arange(len(rollouts)), count)
        rank = np.arange(len(of)) - np.repeat(count.cumsum() - count, count)
        numbers = self.numbers.get(rollouts[of], turn[of], attempt[of] + rank)
        return Attempts(rollouts[of], count, of, rank, numbers)

    def position_logits(self, rollouts: Int64[np.ndarray, " asked"]) -> Tensor:
        """Return the logits of positions of some rollouts [asked, cell]."""
        assert self.query is not None
        assert self.query.position_logits is not None
        if self._are_all(rollouts):
            return self.query.position_logits
        return self.query.position_logits[self.batch.request.simulator.tensor(rollouts)]

    def some_entries(self, rollouts: Int64[np.ndarray, " asked"]) -> Insertions:
        """Return the token step of some rollouts, each once or more, for the network."""
        if self._are_all(rollouts):
            return self.entries
        return self.entries.take(self.batch.request.simulator.tensor(rollouts))

    def _are_all(self, rollouts: Int64[np.ndarray, " asked"]) -> bool:
        """Tell whether every rollout is asked, each once."""
        every = len(rollouts) == len(self.turn)
        return every and bool((rollouts == np.arange(len(rollouts))).all())

    def _query(self, rollouts: Int64[np.ndarray, " asked"]) -> Bool[np.ndarray, " asked"]:
        """Ask whether one more agent is inserted; full rollouts insert none."""
        batch, request = self.batch, self.batch.request
        simulator = request.simulator
        query = simulator.stepper.entry_query(self.some_entries(rollouts))
        if query.position_logits is not None:
            # In place: no other code keeps these logits.
            taken = simulator.tensor(batch.occupied[rollouts])
            query.position_logits.masked_fill_(taken, -torch.inf)
        if self.query is None:  # The first query is of all.
            self.query = query
        else:
            self.query.put(simulator.tensor(rollouts), query)
        bias = simulator.tensor(batch.add_bias(rollouts))
        turn = self.turn[rollouts]
        numbers = self.numbers.get(rollouts, turn, np.zeros_like(turn))
        uniform = simulator.tensor(numbers[TURN_PURPOSES.index(Purpose.ADD)])
        add = simulator.fetch(sample_event(query.add_logit, uniform, bias))[0]
        # A batch has as many rows as its most crowded scene needs: free rows are no limit.
        free: np.ndarray = batch.num_agents[rollouts] < request.most[rollouts]
        return free & add

    def _add(
        self, rollouts: Int64[np.ndarray, " inserted"], inserted: InsertedAgents
    ) -> None:
        """Add the inserted agents to the population and to the input of the network."""
        batch, simulator = self.batch, self.batch.request.simulator
        row = batch.add(rollouts, inserted)
        at = rollouts[row >= 0], row[row >= 0]
        fresh = np.zeros(batch.cells.shape, dtype=bool)
        fresh[at] = True
        rows, token_step = simulator.rows(fresh), self.entries.token_step
        token_step.write(rows.at, simulator.token_step(batch.population, batch.cells, at))
        self.entries = simulator.stepper.entry_add(self.entries, token_step, rows)


def insert_agents(
    request: InsertionRequest, memory: StepMemory, population: Population, token: int
) -> Population:
    """Insert agents into every rollout until the network samples BEGIN MOTION.

    A position that is not allowed is sampled again in another cell, up to
    ``max_insertion_attempts`` times: the network chooses among the allowed positions.
    """
    simulator, batch = request.simulator, InsertionState.of(request, population)
    entries = simulator.stepper.entry_begin(
        memory,
        # Of the batch's own arrays, which it may share: both change in place.
        simulator.token_step(batch.population, batch.cells),
        simulator.rows(population.visible),
    )
    turns = _Turns.of(batch, entries, token)
    inserts = simulator.settings.max_insertions > 0
    active = np.arange(len(request.streams) if inserts else 0)
    while len(active):
        active = turns.advance(active)
    return batch.population


def _sample_agents(turns: _Turns, attempts: Attempts) -> InsertedAgents:
    """Sample cell, type, size, heading and offset of every attempt.

    Everything is sampled where the network is, and fetched at once.
    """
    simulator = turns.batch.request.simulator
    grid = simulator.grid

    def uniforms(purpose: Purpose) -> Tensor:
        return simulator.tensor(attempts.numbers[TURN_PURPOSES.index(purpose)])

    cell, regressed_m = _sample_cells(turns, attempts, uniforms(Purpose.CELL))
    entries = turns.some_entries(attempts.rollout)
    details = simulator.stepper.entry_details(entries, cell, regressed_m)
    agent_type = choose(details.agent_type_logits, uniforms(Purpose.AGENT_TYPE))
    offset, heading = sample_offset_and_heading(simulator, details, agent_type, uniforms)
    size_lwh_m = of_type(details.size_lwh_m, agent_type)
    more = offset if regressed_m is None else regressed_m
    parts = [cell, agent_type, size_lwh_m, heading, *([] if more is None else [more])]
    cells, types, sizes, headings, *rest = simulator.fetch(*parts)

    position_m = grid.centre_m[cells]
    if regressed_m is not None:
        position_m = rest[0]
    elif rest:
        offset_m = rest[0] if details.query is None else grid.offset_m[rest[0]]
        position_m = _within(position_m + offset_m, grid)
    if details.turned_rad is None:
        headings = decode_heading(headings.astype(np.int16), grid)
    return InsertedAgents(
        who=np.ones(len(cells), dtype=bool),
        position_m=position_m,
        turned_rad=headings,
        agent_type=types.astype(np.int8),
        size_lwh_m=sizes,
    )


def _sample_cells(
    turns: _Turns, attempts: Attempts, uniform: Tensor
) -> tuple[Tensor, Tensor | None]:
    """Sample a cell per attempt, or take those of regressed positions, returned as well.

    The cells are excluded until the next turn.
    """
    simulator = turns.batch.request.simulator
    settings, query = simulator.settings, turns.query
    assert query is not None
    rollout = simulator.tensor(attempts.rollout)
    if query.position_logits is None:
        assert query.position_m is not None
        asked_m = simulator.fetch(query.position_m[rollout])[0]
        position_m = _within(asked_m, simulator.grid)
        cells = encode_cell(position_m, simulator.grid).astype(np.int64)
        return simulator.tensor(cells), simulator.tensor(position_m)
    cell = torch.empty_like(rollout)
    for places in attempts.by_rank():
        at = simulator.tensor(places)
        logits = turns.position_logits(attempts.rollout[places])
        cell[at] = chosen = choose(
            logits,
            uniform[at],
            settings.position_top_k,
            nucleus=settings.position_top_p,
            temperature=settings.position_temperature,
        )
        query.position_logits[rollout[at], chosen] = -torch.inf
    return cell, None


def _within(position_m: np.ndarray, grid: Grid) -> np.ndarray:
    """Move positions of the grid frame that are outside the grid to its rim."""
    far = np.hypot(position_m[:, 0], position_m[:, 1]) / np.float32(INSIDE * grid.radius_m)
    return position_m / np.maximum(far, np.float32(1))[:, None]


def sample_offset_and_heading(
    simulator: Simulator,
    details: InsertionDetails,
    agent_type: Tensor,
    uniforms: UniformNumbers,
) -> tuple[Tensor | None, Tensor]:
    """Sample the offset and the heading of every inserted agent.

    Returns:
        The bin of the offset in its cell if ``details.query`` is there, else the offset in
        metres, or None; and the heading: relative to the ego if ``details.turned_rad`` is
        there, else its bin.
    """
    settings, query, logits = simulator.settings, details.query, details.heading_logits
    offset = None if details.offset_m is None else of_type(details.offset_m, agent_type)
    if query is not None:
        said = query.offset_logits(agent_type)
        offset = choose(said, uniforms(Purpose.OFFSET), nucleus=settings.offset_top_p)
        by_type = query.heading_logits(agent_type, offset)
    elif logits is not None:
        by_type = of_type(logits, agent_type)
    else:
        assert details.turned_rad is not None
        return offset, of_type(details.turned_rad, agent_type)
    heading = choose(
        by_type,
        uniforms(Purpose.HEADING),
        nucleus=settings.heading_top_p,
        temperature=settings.heading_temperature,
    )
    return offset, heading


def of_type(values: Tensor, agent_type: Tensor) -> Tensor:
    """Take the values [rollout, ...] of the sampled agent types."""
    return values[torch.arange(len(agent_type), device=agent_type.device), agent_type]
