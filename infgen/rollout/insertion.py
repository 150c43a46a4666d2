"""Newcomers of one half second: the network is asked for one after the other."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from infgen.model.stepping import Entries, Memory
from infgen.model.token_step import EntryDetails, EntryQuery
from infgen.rollout.insertion_mask import Room
from infgen.rollout.population import Newcomers, Population, enter
from infgen.rollout.random_streams import Purpose, Stream
from infgen.rollout.sampling import choose, happens
from infgen.rollout.simulator import Player
from infgen.tokens.grid import Grid, decode_cell, decode_heading, encode_cell
from infgen.tokens.scene_tokens import NO_CELL

INSIDE = 0.999
"""Share of the grid's radius that newcomers keep within, whatever their offsets."""

Luck = Callable[[Purpose], Tensor]


@dataclass(frozen=True, slots=True)
class Asking:
    """Who asks whom for newcomers.

    Attributes:
        player: The network.
        streams: Random numbers of the rollouts.
        room: Where newcomers may stand; None for anywhere.
        most: Agents that each rollout may have at any one time.
        wanted: How many others are to be around each ego; None for as many as enter.
    """

    player: Player
    streams: Sequence[Stream]
    room: Room | None
    most: Int64[np.ndarray, " rollout"]
    wanted: Float64[np.ndarray, " rollout"] | None = None

    @property
    def tries(self) -> int:
        """How often a newcomer may be asked for."""
        return 1 if self.room is None else self.player.settings.max_insertion_attempts

    def luck(self, token: int, turn: int, attempt: int = 0) -> Luck:
        """Random numbers of a newcomer of each rollout."""
        # A longer draw starts with the shorter one: the first try is always the same.
        return lambda purpose: self.player.luck(
            self.streams, token, purpose, attempt + 1, turn
        )[:, attempt]

    def take(self, places: Int64[np.ndarray, " kept"]) -> "Asking":
        """Go on with some rollouts only."""
        room = None if self.room is None else self.room.take(places)
        return replace(
            self,
            streams=[self.streams[at] for at in places],
            room=room,
            most=self.most[places],
            wanted=None if self.wanted is None else self.wanted[places],
        )

    def add_bias(self, population: Population) -> Float64[np.ndarray, " rollout"]:
        """What is added to the log-odds that one more enters."""
        settings = self.player.settings
        bias = np.full(len(self.streams), settings.add_bias)
        if self.wanted is not None:
            there = population.count_others(self.player.grid.radius_m)
            # One is asked for after another: how many come is proportional to the odds.
            bias += settings.density_control * np.log((self.wanted + 1) / (there + 1))
        return bias


@dataclass(frozen=True, slots=True)
class _Party:
    """Rollouts that still ask for newcomers; the others cost nothing more.

    Attributes:
        asking: Whom they ask.
        entries: The half second, as the network sees it.
        population: Everyone in them, newcomers so far among them.
        rollout: Their places in the batch.
    """

    asking: Asking
    entries: Entries
    population: Population
    rollout: Int64[np.ndarray, " rollout"]

    def __len__(self) -> int:
        return len(self.rollout)

    def take(self, which: Bool[np.ndarray, " rollout"]) -> "_Party":
        """Go on with some of them."""
        if which.all():
            return self
        places = np.flatnonzero(which)
        return _Party(
            asking=self.asking.take(places),
            entries=self.entries.take(self.asking.player.tensor(places)),
            population=self.population.take(places),
            rollout=self.rollout[places],
        )

    def enter(self, newcomers: Newcomers) -> "_Party":
        """Let the newcomers in, where the others and the network see them."""
        player, (population, _) = self.asking.player, enter(self.population, newcomers)
        entries = player.stepper.entry_add(self.entries, player.column(population))
        return replace(self, entries=entries, population=population)


def add_newcomers(
    asking: Asking, memory: Memory, population: Population, token: int
) -> Population:
    """Let newcomers enter every rollout until the network says that motion begins."""
    player, everyone = asking.player, np.arange(len(asking.streams))
    entries = player.stepper.entry_begin(memory, player.column(population))
    party = _Party(asking, entries, population, everyone)
    for turn in range(player.settings.max_insertions):
        party, newcomers = _next_newcomers(party, token, turn)
        if newcomers is None:
            break
        party = party.enter(newcomers)
        population = population.put(party.rollout, party.population)
    return population


def _next_newcomers(
    party: _Party, token: int, turn: int
) -> tuple[_Party, Newcomers | None]:
    """Ask every rollout of a party for its next newcomer, if it has room for one.

    Returns:
        Those who have one, and the newcomers; None if there are none.
    """
    player, luck = party.asking.player, party.asking.luck(token, turn)
    query = player.stepper.entry_query(party.entries)
    bias = player.tensor(party.asking.add_bias(party.population))
    add = happens(query.add_logit, luck(Purpose.ADD), bias)
    # Free rows alone do not count: a batch has as many as its most crowded scene needs.
    wanted = add.cpu().numpy() & (party.population.num_agents < party.asking.most)
    party, query = party.take(wanted), query.take(player.tensor(np.flatnonzero(wanted)))
    found = _find_places(party, query, token, turn) if len(party) else None
    if found is None or not found.who.any():
        return party, None
    return party.take(found.who), found.take(np.flatnonzero(found.who))


def _find_places(party: _Party, query: EntryQuery, token: int, turn: int) -> Newcomers:
    """Sample a newcomer of every rollout, and whether there is a place for it.

    Who may not stand where it is to enter is asked for again, in another cell: the choice
    is that of the network, given that it is allowed. After some tries there is none.
    """
    player, found = party.asking.player, None
    taken = _taken(party.population.cells(player.grid), player.grid.num_cells)
    left = np.ones(len(party), dtype=bool)
    for attempt in range(party.asking.tries):
        asked, places = party.take(left), np.flatnonzero(left)
        newcomers, cell = _describe(
            asked,
            query.take(player.tensor(places)),
            taken[places],
            asked.asking.luck(token, turn, attempt),
        )
        room = asked.asking.room
        if room is not None:
            newcomers = replace(newcomers, who=room.allows(asked.population, newcomers))
        found = newcomers if found is None else found.put(places, newcomers)
        taken[places, cell] = True
        left = ~found.who
        if not left.any():
            break
    assert found is not None
    return found


def _describe(
    party: _Party,
    query: EntryQuery,
    taken: Bool[np.ndarray, "rollout cell"],
    luck: Luck,
) -> tuple[Newcomers, np.ndarray]:
    """Sample who enters every rollout, and its cell [rollout]."""
    player = party.asking.player
    cell, place_m = _place(player, query, taken, luck)
    asked_at = None if query.cell_logits is not None else player.tensor(place_m)
    details = player.stepper.entry_details(
        party.entries, player.tensor(cell.astype(np.int64)), asked_at
    )
    kind = choose(details.kind_logits, luck(Purpose.KIND))
    if details.offset_m is not None:
        offset_m = _of_kind(details.offset_m, kind).cpu().numpy()
        place_m = _within(place_m + offset_m, player.grid)
    found = Newcomers(
        who=np.ones(len(cell), dtype=bool),
        place_m=place_m,
        turned_rad=_heading(player, details, kind, luck),
        kind=kind.cpu().numpy().astype(np.int8),
        size_lwh_m=_of_kind(details.size_lwh_m, kind).cpu().numpy(),
    )
    return found, cell


def _place(
    player: Player, query: EntryQuery, taken: np.ndarray, luck: Luck
) -> tuple[np.ndarray, np.ndarray]:
    """Cell of every rollout's newcomer, and where it is asked for in the grid frame."""
    settings, grid = player.settings, player.grid
    if query.cell_logits is not None:
        drawn = choose(
            query.cell_logits.masked_fill(player.tensor(taken), float("-inf")),
            luck(Purpose.CELL),
            settings.position_top_k,
            nucleus=settings.position_top_p,
            temperature=settings.position_temperature,
        )
        cell = drawn.cpu().numpy().astype(np.int16)
        return cell, decode_cell(cell, grid)
    assert query.place_m is not None
    place_m = _within(query.place_m.cpu().numpy(), grid)
    return encode_cell(place_m, grid), place_m


def _within(place_m: np.ndarray, grid: Grid) -> np.ndarray:
    """Bring places of the grid frame that are outside the grid to its rim."""
    far = np.hypot(place_m[:, 0], place_m[:, 1]) / np.float32(INSIDE * grid.radius_m)
    return place_m / np.maximum(far, np.float32(1))[:, None]


def _heading(player: Player, details: EntryDetails, kind: Tensor, luck: Luck) -> np.ndarray:
    """Heading of every rollout's newcomer relative to the ego."""
    if details.heading_logits is None:
        assert details.turned_rad is not None
        return _of_kind(details.turned_rad, kind).cpu().numpy()
    drawn = choose(
        _of_kind(details.heading_logits, kind),
        luck(Purpose.HEADING),
        temperature=player.settings.heading_temperature,
    )
    return decode_heading(drawn.cpu().numpy().astype(np.int16), player.grid)


def _of_kind(values: Tensor, kind: Tensor) -> Tensor:
    """Take [rollout, ...] of the kind that each rollout's newcomer has."""
    return values[torch.arange(len(kind), device=kind.device), kind]


def _taken(cells: np.ndarray, count: int) -> Bool[np.ndarray, "rollout cell"]:
    """Mark cells that hold an agent: nobody enters on top of another."""
    taken = np.zeros((len(cells), count + 1), dtype=bool)
    # Agents outside the grid fall into an extra last column.
    np.put_along_axis(taken, np.where(cells == NO_CELL, -1, cells), True, axis=1)
    return taken[:, :-1]
