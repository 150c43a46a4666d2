"""State of a batch while agents are inserted, kept on the host."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int16, Int64

from infgen.rollout.population import (
    EGO_ROW,
    InsertedAgents,
    Population,
    place_inserted,
)
from infgen.rollout.random_streams import WORDS, Purpose, Streams
from infgen.rollout.rules.insertion_mask import Circles, InsertionMask
from infgen.rollout.simulator import Simulator
from infgen.tokens.grid import encode_cell, to_grid
from infgen.tokens.scene_tokens import NO_CELL

TURN_PURPOSES = (
    *(Purpose.ADD, Purpose.CELL, Purpose.AGENT_TYPE, Purpose.HEADING),
    Purpose.OFFSET,
)
"""What is sampled in one insertion."""
TURNS_AT_ONCE = 4
"""Turns whose random numbers are drawn together."""


@dataclass(frozen=True, slots=True)
class InsertionRequest:
    """What insertion needs besides the agents: network, random numbers and limits.

    Attributes:
        simulator: The network.
        streams: Random numbers of the rollouts.
        insertion_mask: Rejects positions; None allows all.
        most: Most agents of each rollout at any one time.
        wanted: Number of other agents wanted around each ego; None for no control.
        rate: Latent rates, added to the log-odds of ADD; None without.
    """

    simulator: Simulator
    streams: Streams
    insertion_mask: InsertionMask | None
    most: Int64[np.ndarray, " rollout"]
    wanted: Float64[np.ndarray, " rollout"] | None = None
    rate: Float64[np.ndarray, " rollout"] | None = None

    @property
    def attempts(self) -> int:
        """Number of positions sampled for one insertion before it is given up."""
        if self.insertion_mask is None:
            return 1
        return self.simulator.rules.max_insertion_attempts


@dataclass(slots=True)
class TurnNumbers:
    """The uniform numbers of the insertions of one token step.

    Attributes:
        streams: Random numbers of the rollouts.
        token: Token step.
        numbers: Those of four attempts, by purpose, of the turns drawn so far: of each turn
            the attempts that a rollout is at.
    """

    streams: Streams
    token: int
    numbers: Float64[np.ndarray, "purpose rollout turn 4"]

    @classmethod
    def of(cls, streams: Streams, token: int) -> "TurnNumbers":
        """Begin a token step; no number is drawn yet."""
        return cls(streams, token, np.zeros((len(TURN_PURPOSES), len(streams), 0, WORDS)))

    def draw(
        self,
        rollouts: Int64[np.ndarray, " asked"],
        turn: Int64[np.ndarray, " asked"],
        attempt: Int64[np.ndarray, " asked"],
    ) -> None:
        """Draw numbers of all rollouts that go on, if one of them is behind the last turn.

        Attempts beyond the first four are drawn when a rollout comes to them.
        """
        known = self.numbers.shape[2]
        if turn.max() >= known:
            turns = range(known, known + TURNS_AT_ONCE)
            drawn = np.zeros((*self.numbers.shape[:2], TURNS_AT_ONCE, WORDS))
            drawn[:, rollouts] = self.streams.take(rollouts).uniform_turns(
                self.token, TURN_PURPOSES, turns
            )
            self.numbers = np.concatenate([self.numbers, drawn], axis=2)
        more = (attempt > 0) & (attempt % WORDS == 0)
        if more.any():
            some = rollouts[more]
            self.numbers[:, some, turn[more]] = self.streams.take(some).uniform_block(
                self.token, TURN_PURPOSES, attempt[more] // WORDS, turn[more]
            )

    def get(
        self,
        rollouts: Int64[np.ndarray, " asked"],
        turn: Int64[np.ndarray, " asked"],
        attempt: Int64[np.ndarray, " asked"],
    ) -> Float64[np.ndarray, "purpose asked"]:
        """Return the numbers of each rollout at an attempt that was drawn."""
        return self.numbers[:, rollouts, turn, attempt % WORDS]


@dataclass(frozen=True, slots=True)
class Attempts:
    """Positions that are sampled at once: of each active rollout one or several in a row.

    Attributes:
        rollout: Rollout of each attempt, in order.
        count: Attempts of each active rollout.
        of: Place of each attempt's rollout among the active ones.
        rank: Which attempt of its rollout it is, of those made at once.
        numbers: Its uniform numbers.
    """

    rollout: Int64[np.ndarray, " attempt"]
    count: Int64[np.ndarray, " active"]
    of: Int64[np.ndarray, " attempt"]
    rank: Int64[np.ndarray, " attempt"]
    numbers: Float64[np.ndarray, "purpose attempt"]

    def by_rank(self) -> Iterator[Int64[np.ndarray, " some"]]:
        """Yield the places of the first attempts of all, then of the second ones."""
        for rank in range(int(self.count.max(initial=0))):
            yield np.flatnonzero(self.rank == rank)

    def first(self, allowed: Bool[np.ndarray, " attempt"]) -> Int64[np.ndarray, " active"]:
        """Return the place of each active rollout's first allowed attempt, or -1."""
        found = np.full(len(self.count), -1)
        places = np.flatnonzero(allowed)[::-1]
        found[self.of[places]] = places  # The last one that is written is the first.
        return found


@dataclass(slots=True)
class InsertionState:
    """All rollouts of a batch while agents are inserted; changes in place.

    Attributes:
        request: What insertion needs.
        population: All agents, those inserted so far included.
        cells: Cell of each agent, or ``NO_CELL``.
        occupied: Cells that hold an agent: no other is inserted there.
        num_agents: Agents of each rollout.
        num_others: Agents around each ego, itself excluded.
        circles: Circles that hold the boxes; None without an insertion mask.
    """

    request: InsertionRequest
    population: Population
    cells: Int16[np.ndarray, "rollout row"]
    occupied: Bool[np.ndarray, "rollout cell"]
    num_agents: Int64[np.ndarray, " rollout"]
    num_others: Int64[np.ndarray, " rollout"]
    circles: Circles | None

    @classmethod
    def of(cls, request: InsertionRequest, population: Population) -> "InsertionState":
        """Begin with all agents after they have moved."""
        grid, mask = request.simulator.grid, request.insertion_mask
        cells = population.cells(grid)
        return cls(
            request,
            population.copy(),
            cells,
            _occupied(cells, grid.num_cells),
            population.num_agents,
            population.count_others(grid.radius_m),
            None if mask is None else mask.circles(population),
        )

    def add_bias(
        self, rollouts: Int64[np.ndarray, " asked"]
    ) -> Float64[np.ndarray, " asked"]:
        """Return what is added to the logit of ADD, with density control."""
        simulator, wanted = self.request.simulator, self.request.wanted
        bias = np.full(len(rollouts), simulator.settings.add_bias)
        if self.request.rate is not None:
            bias += self.request.rate[rollouts]
        if wanted is not None:
            there = self.num_others[rollouts]
            # Insertions are sampled one by one: their number is proportional to the odds.
            odds = (wanted[rollouts] + 1) / (there + 1)
            bias += simulator.rules.density_control * np.log(odds)
        return bias

    def add(
        self, rollouts: Int64[np.ndarray, " inserted"], inserted: InsertedAgents
    ) -> Int64[np.ndarray, " inserted"]:
        """Insert agents; return the row of each, -1 in a full rollout."""
        grid, everyone = self.request.simulator.grid, self.population
        row = place_inserted(everyone, rollouts, inserted)
        at = (rollouts[row >= 0], row[row >= 0])
        away_m = everyone.pose[at][:, :2] - everyone.pose[at[0], EGO_ROW, :2]
        self.num_agents[at[0]] += 1
        self.num_others[at[0]] += np.hypot(*away_m.T) < grid.radius_m
        cell = encode_cell(
            to_grid(everyone.pose[at][:, :2], everyone.pose[at[0], EGO_ROW]), grid
        )
        self.cells[at] = cell
        self.occupied[at[0][cell != NO_CELL], cell[cell != NO_CELL]] = True
        mask, circles = self.request.insertion_mask, self.circles
        if mask is not None and circles is not None:
            circles.put(at, mask.circles(everyone, at))
        return row


def _occupied(
    cells: Int16[np.ndarray, "rollout row"], count: int
) -> Bool[np.ndarray, "rollout cell"]:
    """Mark the cells that hold an agent."""
    occupied = np.zeros((len(cells), count), dtype=bool)
    rollout, row = np.nonzero(cells != NO_CELL)
    occupied[rollout, cells[rollout, row]] = True
    return occupied
