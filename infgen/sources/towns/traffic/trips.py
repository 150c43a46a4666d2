"""Where road users go: walks at random over the streets of a town."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from infgen.sources.towns.streets import curves
from infgen.sources.towns.streets.network import Network, Use
from infgen.sources.towns.streets.street_types import Rank

_TURN_WEIGHTS = {"s": 1.0, "r": 0.45, "R": 0.45, "l": 0.4, "L": 0.4, "t": 0.02}
RANK_WEIGHTS: dict[int, float] = {Rank.LOCAL: 0.25, Rank.COLLECTOR: 1.0, Rank.ARTERIAL: 2.2}
"""How much traffic streets draw, by rank; of a roundabout as a collector."""
_AGAIN_WEIGHT = 0.15
"""Who was on a street not long ago rather takes another."""
_REMEMBERED = 8


@dataclass(frozen=True)
class Ways:
    """What follows what, for one kind of road user.

    Attributes:
        follows: Edges that each edge leads to, and how much each is liked.
        length_m: Of each edge.
        busy: How much traffic each edge has, compared with one lane of a collector.
        sources: Edges that come from out of town.
        exits: Edges that lead out of town.
    """

    follows: dict[str, tuple[tuple[str, ...], tuple[float, ...]]]
    length_m: dict[str, float]
    busy: dict[str, float]
    sources: tuple[str, ...]
    exits: frozenset[str]

    @cached_property
    def inner(self) -> tuple[str, ...]:
        """Edges that neither come from nor lead out of town, but lead on."""
        out = {*self.sources, *self.exits}
        return tuple(
            name for name, (onward, _) in self.follows.items() if onward and name not in out
        )

    def walk(
        self, start: str, least_m: float, rng: np.random.Generator, *, leave: bool = True
    ) -> list[str]:
        """Walk from an edge until a length is reached or the way leads out of town.

        Args:
            start: First edge.
            least_m: The walk ends when it is so long.
            rng: Of the turns.
            leave: Whether it may lead out of town.
        """
        route, walked_m = [start], self.length_m[start]
        while walked_m < least_m and route[-1] not in self.exits:
            names, weights = self.follows[route[-1]]
            liking = np.array(weights)
            recent = set(route[-_REMEMBERED:])
            liking *= [_AGAIN_WEIGHT if name in recent else 1.0 for name in names]
            if not leave:
                liking *= [name not in self.exits for name in names]
            if not liking.sum():
                break
            route.append(names[rng.choice(len(names), p=liking / liking.sum())])
            walked_m += self.length_m[route[-1]]
        return route


def find_ways(network: Network, *, cycling: bool) -> Ways:
    """List what follows what for drivers, or for cyclists."""
    usable: Callable[[str], bool] = (
        (lambda lane: network.lanes[lane].cycled)
        if cycling
        else (lambda lane: network.lanes[lane].use is Use.DRIVERS)
    )
    liked: dict[str, dict[str, float]] = {name: {} for name in network.edges}
    for each in network.connectors:
        if usable(each.start) and usable(each.end):
            start, end = network.edge_of[each.start].name, network.edge_of[each.end].name
            liking = RANK_WEIGHTS.get(network.edges[end].rank, 1.0)
            weight = _TURN_WEIGHTS.get(each.turn, 0.1) * liking
            liked[start][end] = max(weight, liked[start].get(end, 0.0))
    edges = network.edges.values()
    return Ways(
        follows={
            name: (tuple(onward), tuple(onward.values())) for name, onward in liked.items()
        },
        length_m={each.name: curves.length(each.inner.xy_m) for each in edges},
        busy={
            each.name: RANK_WEIGHTS.get(each.rank, 1.0)
            * max(1, sum(lane.use is Use.DRIVERS for lane in each.lanes))
            for each in edges
        },
        sources=tuple(each.name for each in edges if each.start in network.ends),
        exits=frozenset(each.name for each in edges if each.end in network.ends),
    )


def find_walks(
    network: Network, count: int, longest_m: float, rng: np.random.Generator
) -> list[Sequence[str]]:
    """Draw walks along pavements: edges in a row, each from where the last one led."""
    paved = [each for each in network.edges.values() if each.lanes[0].use is Use.WALKERS]
    meets: dict[str, list[int]] = {}
    for at, edge in enumerate(paved):
        for place in (edge.start, edge.end):
            meets.setdefault(place, []).append(at)
    walks: list[Sequence[str]] = []
    for _ in range(count):
        at = int(rng.integers(len(paved)))
        place = str(rng.choice([paved[at].start, paved[at].end]))
        walk, left_m = [paved[at].name], rng.uniform(60.0, longest_m)
        while left_m > 0:
            left_m -= curves.length(paved[at].inner.xy_m)
            onward = [each for each in meets[place] if paved[each].name not in walk]
            if not onward:
                break
            at = onward[rng.integers(len(onward))]
            place = paved[at].end if paved[at].start == place else paved[at].start
            walk.append(paved[at].name)
        walks.append(walk)
    return walks
