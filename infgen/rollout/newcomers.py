"""Newcomers of one half second: the network is asked for one after the other."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from infgen.model.columns import EntryDetails, EntryQuery
from infgen.model.steps import Entries, Memory
from infgen.rollout.player import Player
from infgen.rollout.population import Newcomers, Population, enter
from infgen.rollout.room import Room
from infgen.rollout.sampling import choose, happens
from infgen.rollout.streams import Purpose, Stream
from infgen.rollout.trace import NOBODY
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
    """

    player: Player
    streams: Sequence[Stream]
    room: Room | None

    def tries(self, token: int, turn: int) -> list[Luck]:
        """Random numbers of a newcomer of each rollout, try by try."""
        count = 1 if self.room is None else self.player.settings.entry_tries

        def of_try(at: int) -> Luck:
            # A longer draw starts with the shorter one: the first try is always the same.
            return lambda purpose: self.player.luck(
                self.streams, token, purpose, at + 1, turn
            )[:, at]

        return [of_try(at) for at in range(count)]


def add_newcomers(
    asking: Asking, memory: Memory, population: Population, token: int
) -> Population:
    """Let newcomers enter every rollout until the network says that motion begins."""
    player = asking.player
    entries = player.stepper.entry_begin(memory, player.column(population))
    going_on = np.ones(len(asking.streams), dtype=bool)
    for turn in range(player.settings.max_entries):
        newcomers = _next_newcomers(asking, entries, population, token, turn, going_on)
        going_on = newcomers.who & (population.life == NOBODY).any(axis=1)
        if not going_on.any():
            break
        population, _ = enter(population, newcomers)
        entries = player.stepper.entry_add(entries, player.column(population))
    return population


def _next_newcomers(
    asking: Asking,
    entries: Entries,
    population: Population,
    token: int,
    turn: int,
    going_on: Bool[np.ndarray, " rollout"],
) -> Newcomers:
    """Ask every rollout that still goes on for its next newcomer.

    Who may not stand where it is to enter is asked for again, in another cell: the choice
    is that of the network, given that it is allowed. After some tries there is none.
    """
    player, room = asking.player, asking.room
    query = player.stepper.entry_query(entries)
    tries = asking.tries(token, turn)
    add = happens(query.add_logit, tries[0](Purpose.ADD), player.settings.add_bias)
    wanted = add.cpu().numpy() & going_on
    taken = _taken(population.cells(player.grid), player.grid.num_cells)
    chosen = None
    for luck in tries:
        found, cell = _describe(player, entries, query, taken, luck)
        allowed = wanted.copy()
        if room is not None and wanted.any():
            allowed &= room.allows(population, found)
        chosen = _merge(chosen, replace(found, who=allowed))
        wanted &= ~allowed
        if not wanted.any():
            break
        taken[wanted, cell[wanted]] = True
    assert chosen is not None
    return chosen


def _merge(chosen: Newcomers | None, more: Newcomers) -> Newcomers:
    """Add the newcomers of further rollouts to those chosen so far."""
    if chosen is None:
        return more

    def either(mine: np.ndarray, new: np.ndarray) -> np.ndarray:
        who = more.who.reshape(-1, *(1,) * (new.ndim - 1))
        return np.where(who, new, mine)

    return Newcomers(
        who=chosen.who | more.who,
        place_m=either(chosen.place_m, more.place_m),
        turned_rad=either(chosen.turned_rad, more.turned_rad),
        kind=either(chosen.kind, more.kind),
        size_lwh_m=either(chosen.size_lwh_m, more.size_lwh_m),
    )


def _describe(
    player: Player,
    entries: Entries,
    query: EntryQuery,
    taken: Bool[np.ndarray, "rollout cell"],
    luck: Luck,
) -> tuple[Newcomers, np.ndarray]:
    """Sample who enters every rollout if anyone does, and its cell [rollout]."""
    cell, place_m = _place(player, query, taken, luck)
    asked_at = None if query.cell_logits is not None else player.tensor(place_m)
    details = player.stepper.entry_details(
        entries, player.tensor(cell.astype(np.int64)), asked_at
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
            settings.top_cells,
            nucleus=settings.cell_nucleus,
            temperature=settings.cell_temperature,
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
