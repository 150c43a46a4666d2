"""The numbers that are forecast: counts, entries and exits of each window, from courses."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from infgen.metrics.proper.course import Course

QUANTITIES = ("vehicles", "pedestrians", "cyclists", "entries", "exits")
"""Single numbers: agents within the radius by type, entries, exits."""
ENTRY_DISTANCE = "entry_distance"
"""Entries nearer than a distance, at several distances."""
ENERGY = "energy"
"""All counts by type and ring together."""
SCORES = (*QUANTITIES, ENTRY_DISTANCE, ENERGY)


class Forecast(NamedTuple):
    """What is scored of one course.

    Attributes:
        single: Values of ``QUANTITIES`` in each window.
        nearer: Entries up to the end of each ring in each window.
        cells: Agents by type and ring in each window, flat.
    """

    single: Float64[np.ndarray, "*course window quantity"]
    nearer: Float64[np.ndarray, "*course window ring"]
    cells: Float64[np.ndarray, "*course window cell"]


def read_course(course: Course) -> Forecast:
    """Read the numbers of one course."""
    # Rounded, so that equal counts are equal whatever they are summed from.
    present = course.present.astype(np.float64).round(6)
    entries = course.entries.astype(np.float64)
    exits = course.exits.astype(np.float64).sum(axis=1)
    single = [*np.moveaxis(present.sum(axis=2).round(5), 1, 0), entries.sum(axis=1), exits]
    return Forecast(
        single=np.stack(single, axis=-1),
        nearer=np.cumsum(entries, axis=1),
        cells=present.reshape(len(present), -1),
    )


def read_courses(courses: Sequence[Course]) -> Forecast:
    """Read the numbers of an ensemble; courses are equally long.

    Raises:
        ValueError: if there is none.
    """
    if not courses:
        raise ValueError("an ensemble needs at least one course")
    parts = [read_course(course) for course in courses]
    return Forecast(*(np.stack(values) for values in zip(*parts, strict=True)))


def pad_courses(courses: Sequence[Course]) -> Forecast:
    """Read the numbers of courses of any length; NaN beyond the end of each.

    Raises:
        ValueError: if there is none.
    """
    if not courses:
        raise ValueError("there are no courses to pad")
    longest = max(course.windows for course in courses)
    padded = []
    for values in zip(*map(read_course, courses), strict=True):
        whole = np.full((len(values), longest, values[0].shape[-1]), np.nan)
        for row, part in zip(whole, values, strict=True):
            row[: len(part)] = part
        padded.append(whole)
    return Forecast(*padded)


def keep_now(course: Course) -> Forecast:
    """Forecast that as many agents stay where they are now: nobody enters or exits."""
    windows, now = course.windows, course.now.astype(np.float64)
    single = np.concatenate([now.sum(axis=1), [0.0, 0.0]])
    return Forecast(
        single=np.tile(single, (windows, 1)),
        nearer=np.zeros((windows, course.entries.shape[1])),
        cells=np.tile(now.reshape(-1), (windows, 1)),
    )
