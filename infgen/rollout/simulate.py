"""The closed loop: half a second at a time, for a batch of rollouts.

The order within a half second is SPEC 12.2's: everyone moves, whoever leaves is marked,
then newcomers enter one by one until the network says that motion begins.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from infgen.clock import CLOCK
from infgen.config import RolloutSettings, TokenSettings
from infgen.model.batch import collate_roads
from infgen.model.steps import Column, Entries, Memory, Stepper
from infgen.rollout.population import Newcomers, Population, enter, move_on, settle
from infgen.rollout.sampling import choose, happens
from infgen.rollout.streams import Purpose, Stream, uniforms
from infgen.rollout.trace import NOBODY, Frame, Start
from infgen.tokens.codebook import MotionCodebook, RoadCodebook
from infgen.tokens.grid import Grid, make_grid
from infgen.tokens.scene_tokens import NO_CELL, Presence


@dataclass(frozen=True, slots=True)
class Player:
    """What plays: a network, the words it speaks, and how its choices are sampled.

    Attributes:
        stepper: The network, ready to be played.
        codebook: Its moves.
        roads: Its road tokens.
        tokens: How histories are tokenized for it.
        settings: Length, sampling and caps.
        device: Where the network is.
    """

    stepper: Stepper
    codebook: MotionCodebook
    roads: RoadCodebook
    tokens: TokenSettings
    settings: RolloutSettings
    device: torch.device

    @property
    def grid(self) -> Grid:
        """Cells and headings that newcomers are placed in."""
        return make_grid(self.tokens)

    def tensor(self, values: np.ndarray) -> Tensor:
        """Bring an array to the network's device."""
        return torch.from_numpy(values).to(self.device)

    def column(self, population: Population) -> Column:
        """Show a population to the network."""
        return Column(
            kind=self.tensor(population.kind).long(),
            size_lwh_m=self.tensor(population.size_lwh_m),
            pose=self.tensor(population.pose),
            move=self.tensor(population.move).long(),
            presence=self.tensor(population.presence).long(),
            observed=self.tensor(population.observed),
            cell=self.tensor(population.cells(self.grid)).long(),
        )


@torch.inference_mode()
def simulate(player: Player, starts: Sequence[Start]) -> Iterator[Frame]:
    """Play a batch of rollouts, one frame per half second.

    What a rollout does depends on its own scene, index and seed only, never on the others
    of the batch (but for rounding in the network's sums).

    Args:
        player: Network and settings.
        starts: Scenes to continue; several rollouts of one scene share its map.
    """
    streams = [Stream.of(s.seed, s.scene.scenario_id, s.index) for s in starts]
    history = settle(starts, player.settings.max_agents)
    memory = _begin(player, starts, rows=history[0].life.shape[1])
    for population in history[:-1]:
        player.stepper.motion_step(memory, player.column(population))

    population, now = history[-1], starts[0].history.now
    for token in range(now + 1, now + 1 + CLOCK.tokens_in(player.settings.seconds)):
        population, path = _move(player, memory, population, streams, token)
        moved = population
        if player.settings.insert:
            population = _add_newcomers(player, memory, population, streams, token)
        yield _frame(token, moved, population, path)


def _begin(player: Player, starts: Sequence[Start], rows: int) -> Memory:
    """Encode every map once, however many rollouts of it there are."""
    maps = {start.scene.scenario_id: start.history for start in starts}
    number = {name: at for at, name in enumerate(maps)}
    scene = np.array([number[start.scene.scenario_id] for start in starts], dtype=np.int64)
    longest = max(history.num_roads for history in maps.values())
    roads = collate_roads(list(maps.values()), longest)
    return player.stepper.begin(roads, player.tensor(scene), rows)


def _move(
    player: Player,
    memory: Memory,
    population: Population,
    streams: Sequence[Stream],
    token: int,
) -> tuple[Population, np.ndarray]:
    step = player.stepper.motion_step(memory, player.column(population))
    rows = population.life.shape[1]
    luck = player.tensor(uniforms(streams, token, Purpose.MOVE, rows))
    move = choose(step.move_logits, luck, player.settings.top_moves).cpu().numpy()
    leave = np.zeros(population.life.shape, dtype=bool)
    if player.settings.remove:
        luck = player.tensor(uniforms(streams, token, Purpose.LEAVE, rows))
        leave = happens(step.leave_logit, luck).cpu().numpy()
    return move_on(population, move, leave, player.codebook)


def _add_newcomers(
    player: Player,
    memory: Memory,
    population: Population,
    streams: Sequence[Stream],
    token: int,
) -> Population:
    entries = player.stepper.entry_begin(memory, player.column(population))
    going_on = np.ones(len(streams), dtype=bool)
    for turn in range(player.settings.max_entries):
        newcomers = _propose(player, entries, population, streams, token, turn, going_on)
        going_on = newcomers.who & (population.life == NOBODY).any(axis=1)
        if not going_on.any():
            break
        population, _ = enter(population, newcomers, player.grid)
        entries = player.stepper.entry_add(entries, player.column(population))
    return population


def _propose(
    player: Player,
    entries: Entries,
    population: Population,
    streams: Sequence[Stream],
    token: int,
    turn: int,
    going_on: Bool[np.ndarray, " rollout"],
) -> Newcomers:
    """Ask every rollout that still goes on for its next newcomer."""

    def luck(purpose: Purpose) -> Tensor:
        return player.tensor(uniforms(streams, token, purpose, 1, turn)[:, 0])

    query = player.stepper.entry_query(entries)
    add = happens(query.add_logit, luck(Purpose.ADD)).cpu().numpy() & going_on
    logits = _without_taken(query.cell_logits, population.cells(player.grid))
    cell = choose(logits, luck(Purpose.CELL), player.settings.top_cells)
    details = player.stepper.entry_details(entries, cell)
    kind = choose(details.kind_logits, luck(Purpose.KIND))
    heading = choose(_of_kind(details.heading_logits, kind), luck(Purpose.HEADING))
    return Newcomers(
        who=add,
        cell=cell.cpu().numpy().astype(np.int16),
        offset_m=_of_kind(details.offset_m, kind).cpu().numpy(),
        heading=heading.cpu().numpy().astype(np.int16),
        kind=kind.cpu().numpy().astype(np.int8),
        size_lwh_m=_of_kind(details.size_lwh_m, kind).cpu().numpy(),
    )


def _of_kind(values: Tensor, kind: Tensor) -> Tensor:
    """Take [rollout, ...] of the kind that each rollout's newcomer has."""
    return values[torch.arange(len(kind), device=kind.device), kind]


def _without_taken(logits: Tensor, cells: np.ndarray) -> Tensor:
    """Forbid cells [rollout, cell] that hold an agent: nobody enters on top of another."""
    taken = np.zeros((logits.shape[0], logits.shape[1] + 1), dtype=bool)
    # Agents outside the grid fall into an extra last column.
    np.put_along_axis(taken, np.where(cells == NO_CELL, -1, cells), True, axis=1)
    return logits.masked_fill(
        torch.from_numpy(taken[:, :-1]).to(logits.device), float("-inf")
    )


def _frame(token: int, moved: Population, after: Population, path: np.ndarray) -> Frame:
    return Frame(
        token=token,
        life=moved.life,
        path=path,
        leaving=moved.presence == Presence.LEAVING,
        born=np.where(after.life != moved.life, after.life, np.int32(NOBODY)),
        kind=after.kind,
        size_lwh_m=after.size_lwh_m,
    )
