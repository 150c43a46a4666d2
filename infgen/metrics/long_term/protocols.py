"""The long-term metric as data: features, bins, weights, and two protocols (SPEC 8).

``paper`` follows the published definitions, with the choices the paper's evaluation made
where both are possible; ``corrected`` compares like with like. Neither repeats the slips of
the public code (SPEC 8.2): both put both outcomes of an event in the right bin, clip
simulated values as they clip logged ones, leave out invalid steps and score entries.

A protocol's numbers never change: a test holds them all. Another number is another name.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float32

from infgen.metrics.likelihood import Histogram

KINEMATIC, INTERACTIVE, MAP, PLACEMENT = "kinematic", "interactive", "map", "placement"
MAX_BINS = 11

COMPOSITE_WEIGHTS = {KINEMATIC: 0.2, INTERACTIVE: 0.45, MAP: 0.35, PLACEMENT: 0.4}
"""Of the buckets in the composite; without placement the first three, which sum to 1."""


class Scoring(IntEnum):
    """How the values of a feature become a score."""

    STEPS = 0
    """Per agent and window: the geometric mean over steps; then the mean."""
    EVENT = 1
    """Per agent and window: whether it happens at any step; then the geometric mean."""
    COUNT = 2
    """Per half second: how many; then the geometric mean."""
    DISTANCE = 3
    """Per entry or exit and window: where; then the mean."""


@dataclass(frozen=True, slots=True)
class Feature:
    """One long-term feature.

    Attributes:
        name: As in tables; Waymo's where Waymo has one.
        bucket: Group it is averaged in.
        weight: Its share in the bucket.
        histogram: Its bins.
        scoring: How its values become a score.
        is_distance: Whether ``paper`` leaves out values on or beyond the ends of the range.
    """

    name: str
    bucket: str
    weight: float
    histogram: Histogram
    scoring: Scoring
    is_distance: bool = False


_EVENT = Histogram(-0.5, 1.5, 2)

FEATURES = (
    Feature("linear_speed", KINEMATIC, 0.05, Histogram(0.0, 25.0, 10), Scoring.STEPS),
    Feature(
        "linear_acceleration", KINEMATIC, 0.05, Histogram(-12.0, 12.0, 11), Scoring.STEPS
    ),
    Feature("angular_speed", KINEMATIC, 0.05, Histogram(-0.628, 0.628, 11), Scoring.STEPS),
    Feature(
        "angular_acceleration", KINEMATIC, 0.05, Histogram(-3.14, 3.14, 11), Scoring.STEPS
    ),
    Feature(
        "distance_to_nearest_object",
        INTERACTIVE,
        0.1,
        Histogram(-5.0, 40.0, 10),
        Scoring.STEPS,
        is_distance=True,
    ),
    Feature("collision_indication", INTERACTIVE, 0.25, _EVENT, Scoring.EVENT),
    Feature("time_to_collision", INTERACTIVE, 0.1, Histogram(0.0, 5.0, 10), Scoring.STEPS),
    Feature(
        "distance_to_road_edge",
        MAP,
        0.1,
        Histogram(-20.0, 40.0, 10),
        Scoring.STEPS,
        is_distance=True,
    ),
    Feature("offroad_indication", MAP, 0.25, _EVENT, Scoring.EVENT),
    Feature("num_entries", PLACEMENT, 0.1, Histogram(0.0, 10.0, 5), Scoring.COUNT),
    Feature("num_exits", PLACEMENT, 0.1, Histogram(0.0, 10.0, 5), Scoring.COUNT),
    Feature(
        "entry_distance",
        PLACEMENT,
        0.1,
        Histogram(0.0, 75.0, 10),
        Scoring.DISTANCE,
        is_distance=True,
    ),
    Feature(
        "exit_distance",
        PLACEMENT,
        0.1,
        Histogram(0.0, 75.0, 10),
        Scoring.DISTANCE,
        is_distance=True,
    ),
)

STEP_FEATURES = tuple(f for f in FEATURES if f.bucket != PLACEMENT)
"""Features with a value at every step of an agent; they come first."""
ROW = {feature.name: row for row, feature in enumerate(FEATURES)}
NUM_FEATURES = len(FEATURES)


@dataclass(frozen=True, slots=True)
class Protocol:
    """What is compared with what.

    Attributes:
        name: As in tables.
        boxes_lw_m: Length and width of every simulated vehicle, pedestrian and cyclist, or
            None for the agent's own.
        keep_ends: Clip distances to the range and count them, instead of dropping those on
            or beyond its ends.
        min_steps: Valid steps that an agent needs in a window to count in it.
        absent_is_safe: An agent that is not there in a window has no collision there, and
            counts, so that many short lives look safer than few long ones.
        event_radius_m: Entries and exits farther from the ego are not counted, logged or
            simulated; infinite for all.
        unseen_tokens: Last token steps of a log left out of the logged counts, because
            entries and exits in them are unknown.
    """

    name: str
    boxes_lw_m: tuple[tuple[float, float], ...] | None
    keep_ends: bool
    min_steps: int
    absent_is_safe: bool
    event_radius_m: float
    unseen_tokens: int


PAPER = Protocol(
    name="paper",
    boxes_lw_m=((4.3, 1.8), (0.5, 0.5), (1.9, 0.5)),
    keep_ends=False,
    min_steps=1,
    absent_is_safe=True,
    event_radius_m=float("inf"),
    unseen_tokens=2,
)
CORRECTED = Protocol(
    name="corrected",
    boxes_lw_m=None,
    keep_ends=True,
    min_steps=10,
    absent_is_safe=False,
    event_radius_m=75.0,
    unseen_tokens=1,
)
PROTOCOLS = (PAPER, CORRECTED)


def simulated_boxes(
    protocol: Protocol, agent_type: np.ndarray, size_lwh_m: Float32[np.ndarray, "agent 3"]
) -> Float32[np.ndarray, "agent 3"]:
    """Boxes that a protocol gives simulated agents; heights are always their own."""
    if protocol.boxes_lw_m is None:
        return size_lwh_m
    fixed_lw_m = np.array(protocol.boxes_lw_m, dtype=np.float32)[agent_type]
    return np.concatenate([fixed_lw_m, size_lwh_m[:, 2:]], axis=1)
