"""Insertion of agents in one token step, one agent per query of the network."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from infgen.model.step_memory import Insertions, StepMemory
from infgen.model.token_step import InsertionDetails, PositionOutputs
from infgen.rollout.insertion_state import InsertionRequest, InsertionState, TurnNumbers
from infgen.rollout.population import InsertedAgents, Population
from infgen.rollout.random_streams import Purpose
from infgen.rollout.sampling import choose, sample_event
from infgen.rollout.simulator import Simulator
from infgen.tokens.grid import Grid, decode_cell, decode_heading, encode_cell

INSIDE = 0.999
"""Inserted agents stay within this share of the grid radius, whatever their offsets."""

UniformNumbers = Callable[[Purpose], Tensor]


@dataclass(frozen=True, slots=True)
class _ActiveRollouts:
    """Rollouts whose insertion turns go on; nothing is computed for the others.

    Attributes:
        batch: All rollouts.
        entries: The token step of the active ones, as the network sees it.
        rollout: Indices of these in the batch.
    """

    batch: InsertionState
    entries: Insertions
    rollout: Int64[np.ndarray, " rollout"]

    def __len__(self) -> int:
        return len(self.rollout)

    def take(self, which: Bool[np.ndarray, " rollout"]) -> "_ActiveRollouts":
        """Keep some of them."""
        if which.all():
            return self
        places = np.flatnonzero(which)
        return _ActiveRollouts(
            batch=self.batch,
            entries=self.entries.take(self.batch.request.simulator.tensor(places)),
            rollout=self.rollout[places],
        )

    def add_inserted(self, inserted: InsertedAgents) -> "_ActiveRollouts":
        """Add the inserted agents to the population and to the input of the network."""
        batch, simulator = self.batch, self.batch.request.simulator
        row = batch.add(self.rollout, inserted)
        at = self.rollout[row >= 0], row[row >= 0]
        fresh = np.zeros(batch.cells.shape, dtype=bool)
        fresh[at] = True
        rows = simulator.rows(fresh)
        step = simulator.token_step(batch.population, batch.cells, at)
        entries = simulator.stepper.entry_add(
            self.entries, self.entries.token_step.put(rows.at, step), rows
        )
        return replace(self, entries=entries)


def insert_agents(
    request: InsertionRequest, memory: StepMemory, population: Population, token: int
) -> Population:
    """Insert agents into every rollout until the network samples BEGIN MOTION."""
    simulator, batch = request.simulator, InsertionState.of(request, population)
    entries = simulator.stepper.entry_begin(
        memory,
        simulator.token_step(population, batch.cells),
        simulator.rows(population.visible),
    )
    active = _ActiveRollouts(batch, entries, np.arange(len(request.streams)))
    for turn in range(simulator.settings.max_insertions):
        active, inserted = _insert_next(active, token, turn)
        if inserted is None:
            break
        active = active.add_inserted(inserted)
    return batch.population


def _insert_next(
    active: _ActiveRollouts, token: int, turn: int
) -> tuple[_ActiveRollouts, InsertedAgents | None]:
    """Sample the next insertion of every active rollout that has a free row.

    Returns:
        The rollouts that insert an agent, and these agents; None if there are none.
    """
    batch, asked = active.batch, np.arange(len(active))
    request, simulator = batch.request, batch.request.simulator
    numbers = TurnNumbers(request.streams.take(active.rollout), token, turn)
    query = simulator.stepper.entry_query(active.entries)
    bias = simulator.tensor(batch.add_bias(active.rollout))
    uniform = simulator.tensor(numbers.of(Purpose.ADD, asked))
    add = sample_event(query.add_logit, uniform, bias)
    # A batch has as many rows as its most crowded scene needs: free rows are no limit.
    free = batch.num_agents[active.rollout] < request.most[active.rollout]
    wanted = simulator.fetch(add)[0] & free
    places = np.flatnonzero(wanted)
    if not len(places):
        return active, None
    active, query = active.take(wanted), query.take(simulator.tensor(places))
    found = _sample_positions(active, query, numbers, places)
    if not found.who.any():
        return active, None
    return active.take(found.who), found.take(np.flatnonzero(found.who))


def _sample_positions(
    active: _ActiveRollouts,
    query: PositionOutputs,
    numbers: TurnNumbers,
    number: Int64[np.ndarray, " rollout"],
) -> InsertedAgents:
    """Sample an inserted agent of every rollout, and whether its position is allowed.

    A rejected position is sampled again in another cell, up to ``max_insertion_attempts``
    times: the network chooses among the allowed positions.

    Args:
        active: The rollouts.
        query: Logits of their positions.
        numbers: Random numbers of the turn ...
        number: ... and the place of each rollout among them.
    """
    batch, found = active.batch, None
    simulator, mask = batch.request.simulator, batch.request.insertion_mask
    taken, left = batch.occupied[active.rollout], np.ones(len(active), dtype=bool)
    for attempt in range(batch.request.attempts):
        asked, places = active.take(left), np.flatnonzero(left)
        inserted, cell = _sample_agents(
            asked,
            query if left.all() else query.take(simulator.tensor(places)),
            taken if left.all() else taken[places],
            _attempt_numbers(simulator, numbers, number[places], attempt),
        )
        if mask is not None:
            allowed = mask.allows(batch.population, inserted, asked.rollout, batch.circles)
            inserted = replace(inserted, who=allowed)
        found = inserted if found is None else found.put(places, inserted)
        taken[places, cell] = True
        left = ~found.who
        if not left.any():
            break
    assert found is not None
    return found


def _attempt_numbers(
    simulator: Simulator, numbers: TurnNumbers, places: np.ndarray, attempt: int
) -> UniformNumbers:
    """Return the uniform numbers of one attempt of some rollouts, by purpose."""
    return lambda purpose: simulator.tensor(numbers.of(purpose, places, attempt))


def _sample_agents(
    active: _ActiveRollouts,
    query: PositionOutputs,
    taken: Bool[np.ndarray, "rollout cell"],
    uniforms: UniformNumbers,
) -> tuple[InsertedAgents, Int64[np.ndarray, " rollout"]]:
    """Sample position, type, size and heading; return them and the cells.

    Everything is sampled where the network is, and fetched at once.
    """
    simulator, grid = active.batch.request.simulator, active.batch.request.simulator.grid
    cell, regressed_m = _sample_cell(simulator, query, taken, uniforms)
    details = simulator.stepper.entry_details(active.entries, cell, regressed_m)
    agent_type = choose(details.agent_type_logits, uniforms(Purpose.AGENT_TYPE))
    heading = sample_heading(simulator, details, agent_type, uniforms)
    offset_m = None if details.offset_m is None else of_type(details.offset_m, agent_type)
    size_lwh_m = of_type(details.size_lwh_m, agent_type)
    more = offset_m if regressed_m is None else regressed_m
    parts = [cell, agent_type, size_lwh_m, heading, *([] if more is None else [more])]
    cells, types, sizes, headings, *rest = simulator.fetch(*parts)

    position_m = decode_cell(cells.astype(np.int16), grid)
    if regressed_m is not None:
        position_m = rest[0]
    elif rest:
        position_m = _within(position_m + rest[0], grid)
    if details.heading_logits is not None:
        headings = decode_heading(headings.astype(np.int16), grid)
    found = InsertedAgents(
        who=np.ones(len(cells), dtype=bool),
        position_m=position_m,
        turned_rad=headings,
        agent_type=types.astype(np.int8),
        size_lwh_m=sizes,
    )
    return found, cells


def _sample_cell(
    simulator: Simulator,
    query: PositionOutputs,
    taken: Bool[np.ndarray, "rollout cell"],
    uniforms: UniformNumbers,
) -> tuple[Tensor, Tensor | None]:
    """Sample a cell per rollout, or take those of regressed positions, returned as well."""
    settings, grid = simulator.settings, simulator.grid
    if query.position_logits is not None:
        cell = choose(
            query.position_logits.masked_fill(simulator.tensor(taken), float("-inf")),
            uniforms(Purpose.CELL),
            settings.position_top_k,
            nucleus=settings.position_top_p,
            temperature=settings.position_temperature,
        )
        return cell, None
    assert query.position_m is not None
    position_m = _within(simulator.fetch(query.position_m)[0], grid)
    cells = encode_cell(position_m, grid).astype(np.int64)
    return simulator.tensor(cells), simulator.tensor(position_m)


def _within(position_m: np.ndarray, grid: Grid) -> np.ndarray:
    """Move positions of the grid frame that are outside the grid to its rim."""
    far = np.hypot(position_m[:, 0], position_m[:, 1]) / np.float32(INSIDE * grid.radius_m)
    return position_m / np.maximum(far, np.float32(1))[:, None]


def sample_heading(
    simulator: Simulator,
    details: InsertionDetails,
    agent_type: Tensor,
    uniforms: UniformNumbers,
) -> Tensor:
    """Sample the heading of every inserted agent: its bin, or relative to the ego."""
    if details.heading_logits is None:
        assert details.turned_rad is not None
        return of_type(details.turned_rad, agent_type)
    return choose(
        of_type(details.heading_logits, agent_type),
        uniforms(Purpose.HEADING),
        temperature=simulator.settings.heading_temperature,
    )


def of_type(values: Tensor, agent_type: Tensor) -> Tensor:
    """Take the values [rollout, ...] of the sampled agent types."""
    return values[torch.arange(len(agent_type), device=agent_type.device), agent_type]
