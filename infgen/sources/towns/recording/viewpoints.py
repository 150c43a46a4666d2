"""Views of a town: which car records, and when."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from infgen.clock import CLOCK
from infgen.sources.towns.town import Town

START_EVERY = 20
"""Recordings begin at steps that are multiples of it, if nothing else is said."""
LONGEST_EGO_M = 5.6
DRIVE_STEPS = 311
"""Cars are chosen by how far they go in so many steps at least. Chosen by nine seconds,
hardly one would stand: short recordings are to be as parts of long ones are."""
STANDING_M = 2.0
"""A car that stands all the time is chosen as if it went so far."""
BUSY_M, BUSY_MPS = 60.0, 3.0
"""Where more is going on within it, no slower, a car is chosen rather."""


@dataclass(frozen=True, slots=True)
class View:
    """A recording: the car that makes it, and its first step in the town's time."""

    ego: int
    start: int


def draw_views(
    town: Town,
    count: int,
    num_steps: int,
    from_rim_m: float,
    rng: np.random.Generator,
    start_every: int = START_EVERY,
    at_any_time: bool = False,
) -> list[View]:
    """Draw views, no two of one car at one time; fewer if the town has not so many.

    A car is drawn the more likely the farther it goes, then and in the seconds after it;
    or, at any time of its drive alike, the farther it goes in all the time of the town.

    Args:
        town: Where.
        count: How many.
        num_steps: Length of each.
        from_rim_m: How far the car keeps away from where streets end.
        rng: Of all that is drawn.
        start_every: Recordings begin at steps that are multiples of it.
        at_any_time: Whether the way in all the time of the town counts. Then what a car
            does next does not decide whether it is recorded, so as many stand at the end of
            recordings as at their beginning.
    """
    able = _able(town, from_rim_m)
    drive = max(num_steps, min(DRIVE_STEPS, town.num_steps - num_steps))
    starts = np.arange(0, town.num_steps - drive + 1, start_every)
    lasting = np.stack(
        [able[:, start : start + num_steps].all(axis=1) for start in starts], axis=1
    )
    speed_mps = np.linalg.norm(town.bodies.velocity_mps, axis=-1)
    far_m = np.pad(np.cumsum(speed_mps, axis=1), ((0, 0), (1, 0))) * CLOCK.step_s
    way_m = far_m[:, starts + drive - 1] - far_m[:, starts]
    busy = 1 + _moving_near(town, starts + num_steps // 2, speed_mps)
    if at_any_time:
        way_m, busy = far_m[:, -1:], busy.mean(axis=1, keepdims=True)
    weight = np.where(lasting, (STANDING_M + way_m) * busy, 0.0)
    views: list[View] = []
    while len(views) < count and weight.any():
        chosen = int(rng.choice(weight.size, p=(weight / weight.sum()).ravel()))
        ego, at = divmod(chosen, len(starts))
        views.append(View(ego, int(starts[at])))
        # The same seconds of the same car are recorded once; others are rather chosen.
        weight[ego, np.abs(starts - starts[at]) < num_steps] = 0.0
        weight[ego] *= 0.3
    return views


def _moving_near(
    town: Town,
    steps: Int64[np.ndarray, " look"],
    speed_mps: Float64[np.ndarray, "trip step"],
) -> Int64[np.ndarray, "trip look"]:
    """How many move near each road user, at some steps."""
    found = np.zeros((len(town.kind), len(steps)), np.int64)
    for at, step in enumerate(steps.tolist()):
        moving = town.bodies.present[:, step] & (speed_mps[:, step] > BUSY_MPS)
        xy_m = town.bodies.pose[:, step, :2]
        apart_m = np.linalg.norm(xy_m[:, None] - xy_m[moving], axis=-1)
        found[:, at] = (apart_m < BUSY_M).sum(axis=1)
    return found


def _able(town: Town, from_rim_m: float) -> Bool[np.ndarray, "trip step"]:
    """Which cars could record at which step."""
    ends_m = np.array([town.network.places_m[name] for name in sorted(town.network.ends)])
    car = town.car & (town.size_lwh_m[:, 0] < LONGEST_EGO_M)
    able = town.bodies.present & car[:, None]
    for end_m in ends_m:
        apart_m = np.linalg.norm(town.bodies.pose[..., :2] - end_m, axis=-1)
        able &= apart_m > from_rim_m
    return able
