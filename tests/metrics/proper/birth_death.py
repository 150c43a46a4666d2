"""A known generator of courses, in which agents stay or enter by chance; spoilt copies."""

from dataclasses import dataclass, replace

import numpy as np

from infgen.metrics.proper.course import EVENT_RINGS, RINGS, TYPES, Course

STAYS = 0.8
WINDOWS = 4
CELLS = len(TYPES), RINGS


@dataclass(frozen=True)
class Town:
    """A place: how many agents it holds, and how many are there now."""

    mean: np.ndarray
    now: np.ndarray


def towns(random, count) -> list[Town]:
    """Places that differ, with agents as many as they hold on average."""
    means = random.gamma(2.0, 1.0, size=(count, *CELLS))
    return [Town(mean, random.poisson(mean)) for mean in means]


def draw(random, town: Town) -> Course:
    """What may happen in a place."""
    present, entries, exits = [], [], []
    agents = town.now
    for _ in range(WINDOWS):
        stay = random.binomial(agents, STAYS)
        enter = random.poisson((1 - STAYS) * town.mean)
        exits.append(_spread(random, (agents - stay).sum()))
        entries.append(_spread(random, enter.sum()))
        agents = stay + enter
        present.append(agents)
    return Course(
        *(np.array(x, dtype=np.float32) for x in (town.now, present, entries, exits))
    )


def _spread(random, number):
    """Events fall into the outer rings mostly."""
    return random.multinomial(number, np.arange(1, EVENT_RINGS + 1) / 15)


def ensemble(random, town: Town, count) -> list[Course]:
    return [draw(random, town) for _ in range(count)]


def collapsed(random, courses) -> list[Course]:
    """All rollouts are the most common thing."""
    return [_over(courses, lambda x: np.median(x, axis=0))] * len(courses)


def emptied(random, courses) -> list[Course]:
    """Nobody is there."""
    return [_over(courses, lambda x: 0 * x[0])] * len(courses)


def frozen(random, courses) -> list[Course]:
    """Everybody stays."""
    still = _over(courses, lambda x: 0 * x[0])
    present = np.repeat(courses[0].now[None], WINDOWS, axis=0)
    return [replace(still, present=present)] * len(courses)


def dispersed(random, courses) -> list[Course]:
    """Right on average, but for too many and too few in turn."""
    factors = 2 * random.permutation(np.arange(len(courses)) % 2)
    return [
        replace(
            course,
            **{
                name: (factor * getattr(course, name)).astype(np.float32)
                for name in ("present", "entries", "exits")
            },
        )
        for course, factor in zip(courses, factors, strict=True)
    ]


def _over(courses, change):
    names = ("present", "entries", "exits")
    values = {name: change(np.stack([getattr(c, name) for c in courses])) for name in names}
    return replace(courses[0], **{n: v.astype(np.float32) for n, v in values.items()})


COPIES = {f.__name__: f for f in (collapsed, emptied, frozen, dispersed)}
