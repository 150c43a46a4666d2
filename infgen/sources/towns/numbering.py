"""Scenes by number: ten of each town."""

from collections.abc import Iterator
from itertools import groupby

from infgen.scene import Scene
from infgen.sources.towns.recording.scenes import draw_place, record
from infgen.sources.towns.recording.viewpoints import View, draw_views
from infgen.sources.towns.town import Town, make_town, stream

FROM_RIM_M = 125.0
"""Recording cars keep so far from where streets end."""
SCENES_PER_TOWN = 10
"""Recorded in each town: other cars, other times."""
LEAST_STEPS = 500
"""A town is played for at least so long, after it has warmed up."""
WIDE_STEPS = 311
"""For longer records towns are wider: whoever plays them shall not see all of one. Who
turns now and then gets as far as the root of time."""


def draw_scenes(
    seed: int, split: str, num_steps: int, first: int, count: int
) -> Iterator[Scene]:
    """Draw scenes of a split by number.

    Each depends on the seed, the split, its length and its number alone.

    Args:
        seed: Other scenes for another seed.
        split: Name of the split.
        num_steps: Length of each scene, in steps of 0.1 s.
        first: Number of the first scene.
        count: How many.

    Raises:
        SumoError: if SUMO is missing or fails.
    """
    numbers = range(first, first + count)
    for place, wanted in groupby(numbers, key=lambda number: number // SCENES_PER_TOWN):
        name = f"towns/{seed}/{split}/{num_steps}/{place}"
        town, views = _find_town(name, num_steps)
        placed = draw_place(stream(name, "place"))
        for number in wanted:
            at = number % SCENES_PER_TOWN
            rng = stream(name, "scene", at)
            scenario_id = rng.bytes(8).hex()
            yield record(scenario_id, town, views[at], num_steps, placed, rng)


def _find_town(name: str, num_steps: int) -> tuple[Town, list[View]]:
    """Draw towns until one has enough to record."""
    spread = max(1.0, num_steps / WIDE_STEPS) ** 0.5
    attempt = 0
    while True:
        town = make_town(
            stream(name, "town", attempt), max(LEAST_STEPS, 3 * num_steps // 2), spread
        )
        rng = stream(name, "views", attempt)
        views = draw_views(town, SCENES_PER_TOWN, num_steps, FROM_RIM_M, rng)
        if len(views) == SCENES_PER_TOWN:
            return town, views
        attempt += 1
