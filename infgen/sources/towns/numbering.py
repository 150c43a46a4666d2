"""Scenes by number: as many of each town as its variety says, or fewer."""

from collections.abc import Iterator
from itertools import groupby

from infgen.scene import Scene
from infgen.sources.towns.recording.scenes import draw_place, record
from infgen.sources.towns.recording.viewpoints import START_EVERY, View, draw_views
from infgen.sources.towns.town import Town, make_town, stream
from infgen.sources.towns.variety import BASIC, Variety

FROM_RIM_M = 125.0
"""Recording cars keep so far from where streets end."""
LEAST_STEPS = 500
"""A town is played for at least so long, after it has warmed up."""
WIDE_STEPS = 311
"""For longer records towns are wider: whoever plays them shall not see all of one. Who
turns now and then gets as far as the root of time."""


def draw_scenes(
    seed: int,
    split: str,
    num_steps: int,
    first: int,
    count: int,
    variety: Variety = BASIC,
    scenes_per_town: int = 0,
) -> Iterator[Scene]:
    """Draw scenes of a split by number.

    Each depends on the seed, the split, its length, its town and its place among the scenes
    of that town, and the variety alone.

    Args:
        seed: Other scenes for another seed.
        split: Name of the split.
        num_steps: Length of each scene, in steps of 0.1 s.
        first: Number of the first scene.
        count: How many.
        variety: Ranges that towns are drawn from.
        scenes_per_town: Only so many of each town have a number, its first ones; 0 for all
            that the variety has.

    Raises:
        SumoError: if SUMO is missing or fails.
    """
    numbers, each = range(first, first + count), scenes_per_town or variety.scenes_per_town
    kind = "towns" if variety is BASIC else f"towns-{variety.name}"
    for place, wanted in groupby(numbers, key=lambda number: number // each):
        name = f"{kind}/{seed}/{split}/{num_steps}/{place}"
        town, views = _find_town(name, num_steps, variety)
        placed = draw_place(stream(name, "place"))
        for number in wanted:
            at = number % each
            rng = stream(name, "scene", at)
            scenario_id = rng.bytes(8).hex()
            yield record(scenario_id, town, views[at], num_steps, placed, rng)


def _find_town(name: str, num_steps: int, variety: Variety) -> tuple[Town, list[View]]:
    """Draw towns until one has enough to record."""
    spread = max(1.0, num_steps / WIDE_STEPS) ** 0.5
    wanted, inattention = variety.scenes_per_town, variety.drivers.inattention
    every = START_EVERY if inattention is None else inattention.period_steps
    attempt = 0
    while True:
        steps = max(LEAST_STEPS, 3 * num_steps // 2)
        town = make_town(stream(name, "town", attempt), steps, spread, variety)
        rng = stream(name, "views", attempt)
        views = draw_views(
            town, wanted, num_steps, FROM_RIM_M, rng, every, variety.at_any_time
        )
        if len(views) == wanted:
            return town, views
        attempt += 1
