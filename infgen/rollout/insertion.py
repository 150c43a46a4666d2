"""Insertion of agents in one token step, one agent per query of the network."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from infgen.model.step_memory import Insertions, StepMemory
from infgen.model.token_step import InsertionDetails, PositionOutputs
from infgen.rollout.insertion_mask import InsertionMask
from infgen.rollout.population import InsertedAgents, Population, add_inserted
from infgen.rollout.random_streams import Purpose, Streams
from infgen.rollout.sampling import choose, sample_event
from infgen.rollout.simulator import Simulator
from infgen.tokens.grid import Grid, decode_cell, decode_heading, encode_cell
from infgen.tokens.scene_tokens import NO_CELL

INSIDE = 0.999
"""Inserted agents stay within this share of the grid radius, whatever their offsets."""

UniformNumbers = Callable[[Purpose], Tensor]


@dataclass(frozen=True, slots=True)
class InsertionRequest:
    """What insertion needs besides the agents: network, random numbers and limits.

    Attributes:
        simulator: The network.
        streams: Random numbers of the rollouts.
        insertion_mask: Rejects positions; None allows all.
        most: Most agents of each rollout at any one time.
        wanted: Number of other agents wanted around each ego; None for no control.
    """

    simulator: Simulator
    streams: Streams
    insertion_mask: InsertionMask | None
    most: Int64[np.ndarray, " rollout"]
    wanted: Float64[np.ndarray, " rollout"] | None = None

    @property
    def attempts(self) -> int:
        """Number of positions sampled for one insertion before it is given up."""
        if self.insertion_mask is None:
            return 1
        return self.simulator.settings.max_insertion_attempts

    def uniforms(self, token: int, turn: int, attempt: int = 0) -> UniformNumbers:
        """Return the uniform numbers of one insertion of each rollout."""
        # A longer draw starts with the shorter one: the first attempt is always the same.
        return lambda purpose: self.simulator.tensor(
            self.streams.uniform(token, purpose, attempt + 1, turn)[:, attempt]
        )

    def take(self, places: Int64[np.ndarray, " kept"]) -> "InsertionRequest":
        """Keep some rollouts only."""
        insertion_mask = (
            None if self.insertion_mask is None else self.insertion_mask.take(places)
        )
        return replace(
            self,
            streams=self.streams.take(places),
            insertion_mask=insertion_mask,
            most=self.most[places],
            wanted=None if self.wanted is None else self.wanted[places],
        )

    def add_bias(self, population: Population) -> Float64[np.ndarray, " rollout"]:
        """Return what is added to the logit of ADD, with density control."""
        settings = self.simulator.settings
        bias = np.full(len(self.streams), settings.add_bias)
        if self.wanted is not None:
            there = population.count_others(self.simulator.grid.radius_m)
            # Insertions are sampled one by one: their number is proportional to the odds.
            bias += settings.density_control * np.log((self.wanted + 1) / (there + 1))
        return bias


@dataclass(frozen=True, slots=True)
class _ActiveRollouts:
    """Rollouts whose insertion turns go on; nothing is computed for the others.

    Attributes:
        request: What insertion needs.
        entries: The token step, as the network sees it.
        population: All agents, those inserted so far included.
        rollout: Indices of the rollouts in the batch.
    """

    request: InsertionRequest
    entries: Insertions
    population: Population
    rollout: Int64[np.ndarray, " rollout"]

    def __len__(self) -> int:
        return len(self.rollout)

    def take(self, which: Bool[np.ndarray, " rollout"]) -> "_ActiveRollouts":
        """Keep some of them."""
        if which.all():
            return self
        places = np.flatnonzero(which)
        return _ActiveRollouts(
            request=self.request.take(places),
            entries=self.entries.take(self.request.simulator.tensor(places)),
            population=self.population.take(places),
            rollout=self.rollout[places],
        )

    def add_inserted(self, inserted: InsertedAgents) -> "_ActiveRollouts":
        """Add the inserted agents to the population and to the input of the network."""
        simulator = self.request.simulator
        population, _ = add_inserted(self.population, inserted)
        fresh = simulator.rows(population.visible & ~self.population.visible)
        entries = simulator.stepper.entry_add(
            self.entries, simulator.token_step(population), fresh
        )
        return replace(self, entries=entries, population=population)


def insert_agents(
    request: InsertionRequest, memory: StepMemory, population: Population, token: int
) -> Population:
    """Insert agents into every rollout until the network samples BEGIN MOTION."""
    simulator, everyone = request.simulator, np.arange(len(request.streams))
    entries = simulator.stepper.entry_begin(
        memory, simulator.token_step(population), simulator.rows(population.visible)
    )
    active = _ActiveRollouts(request, entries, population, everyone)
    for turn in range(simulator.settings.max_insertions):
        active, inserted = _insert_next(active, token, turn)
        if inserted is None:
            break
        active = active.add_inserted(inserted)
        population = population.put(active.rollout, active.population)
    return population


def _insert_next(
    active: _ActiveRollouts, token: int, turn: int
) -> tuple[_ActiveRollouts, InsertedAgents | None]:
    """Sample the next insertion of every active rollout that has a free row.

    Returns:
        The rollouts that insert an agent, and these agents; None if there are none.
    """
    simulator, uniforms = active.request.simulator, active.request.uniforms(token, turn)
    query = simulator.stepper.entry_query(active.entries)
    bias = simulator.tensor(active.request.add_bias(active.population))
    add = sample_event(query.add_logit, uniforms(Purpose.ADD), bias)
    # A batch has as many rows as its most crowded scene needs: free rows are no limit.
    wanted = simulator.fetch(add)[0] & (active.population.num_agents < active.request.most)
    places = np.flatnonzero(wanted)
    active, query = active.take(wanted), query.take(simulator.tensor(places))
    found = _sample_positions(active, query, token, turn) if len(active) else None
    if found is None or not found.who.any():
        return active, None
    return active.take(found.who), found.take(np.flatnonzero(found.who))


def _sample_positions(
    active: _ActiveRollouts, query: PositionOutputs, token: int, turn: int
) -> InsertedAgents:
    """Sample an inserted agent of every rollout, and whether its position is allowed.

    A rejected position is sampled again in another cell, up to ``max_insertion_attempts``
    times: the network chooses among the allowed positions.
    """
    simulator, found = active.request.simulator, None
    taken = _taken(active.population.cells(simulator.grid), simulator.grid.num_cells)
    left = np.ones(len(active), dtype=bool)
    for attempt in range(active.request.attempts):
        asked, places = active.take(left), np.flatnonzero(left)
        inserted, cell = _sample_agents(
            asked,
            query.take(simulator.tensor(places)),
            taken[places],
            asked.request.uniforms(token, turn, attempt),
        )
        insertion_mask = asked.request.insertion_mask
        if insertion_mask is not None:
            inserted = replace(
                inserted, who=insertion_mask.allows(asked.population, inserted)
            )
        found = inserted if found is None else found.put(places, inserted)
        taken[places, cell] = True
        left = ~found.who
        if not left.any():
            break
    assert found is not None
    return found


def _sample_agents(
    active: _ActiveRollouts,
    query: PositionOutputs,
    taken: Bool[np.ndarray, "rollout cell"],
    uniforms: UniformNumbers,
) -> tuple[InsertedAgents, Int64[np.ndarray, " rollout"]]:
    """Sample position, type, size and heading; return them and the cells.

    Everything is sampled where the network is, and fetched at once.
    """
    simulator, grid = active.request.simulator, active.request.simulator.grid
    cell, regressed_m = _sample_cell(simulator, query, taken, uniforms)
    details = simulator.stepper.entry_details(active.entries, cell, regressed_m)
    agent_type = choose(details.agent_type_logits, uniforms(Purpose.AGENT_TYPE))
    heading = _sample_heading(simulator, details, agent_type, uniforms)
    offset_m = None if details.offset_m is None else _of_type(details.offset_m, agent_type)
    size_lwh_m = _of_type(details.size_lwh_m, agent_type)
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


def _sample_heading(
    simulator: Simulator,
    details: InsertionDetails,
    agent_type: Tensor,
    uniforms: UniformNumbers,
) -> Tensor:
    """Sample the heading of every inserted agent: its bin, or relative to the ego."""
    if details.heading_logits is None:
        assert details.turned_rad is not None
        return _of_type(details.turned_rad, agent_type)
    return choose(
        _of_type(details.heading_logits, agent_type),
        uniforms(Purpose.HEADING),
        temperature=simulator.settings.heading_temperature,
    )


def _of_type(values: Tensor, agent_type: Tensor) -> Tensor:
    """Take the values [rollout, ...] of the sampled agent types."""
    return values[torch.arange(len(agent_type), device=agent_type.device), agent_type]


def _taken(cells: np.ndarray, count: int) -> Bool[np.ndarray, "rollout cell"]:
    """Mark the cells that hold an agent: no other is inserted there."""
    taken = np.zeros((len(cells), count + 1), dtype=bool)
    # Agents outside the grid fall into an extra last column.
    np.put_along_axis(taken, np.where(cells == NO_CELL, -1, cells), True, axis=1)
    return taken[:, :-1]
