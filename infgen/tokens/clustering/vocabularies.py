"""Cluster samples of logs into the two vocabularies.

Logged items fill a vocabulary first. Where they do not suffice, their mirror images follow,
then shapes made by rule, at last ever finer differences. ``Origin`` tells which is which.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8

from infgen.geometry import box_corners
from infgen.tokens.clustering.kdisks import Items, Space, find_disks, mean_gap_m
from infgen.tokens.clustering.made_map_samples import make_arcs
from infgen.tokens.clustering.made_motion_samples import make_fan
from infgen.tokens.clustering.motion_samples import NUM_AGENT_TYPES, MotionSamples
from infgen.tokens.clustering.physical_limits import (
    MotionLimits,
    keeps_limits,
    motion_limits,
)
from infgen.tokens.clustering.settings import VocabSettings
from infgen.tokens.vocabulary import (
    BOX_LW_M,
    MAP_SAMPLE_POINTS,
    MapVocabulary,
    MotionVocabulary,
)

MADE_ANCHOR_M = 0.5
"""A motion token is made by rule where logs show none within this distance."""
MAX_ANCHOR_SHARE = 1 / 8
"""Largest share of a vocabulary for such motion tokens."""
RARE_SHARE = 1 / 4
"""Share of a vocabulary reserved for samples that common rows leave uncovered ..."""
RARE_MOTION_FACTOR, RARE_MAP_FACTOR = 2.0, 3.0
"""... with disks of so many times the tolerance."""
COARSEST_FACTOR = 8
"""Made shapes are laid coarsely first (so many tolerances apart), then ever finer."""

MIN_MAP_TOLERANCE_M, MAX_MAP_TOLERANCE_M = 0.01, 0.64
_BISECTIONS = 8


class Origin(IntEnum):
    """Where a row of a vocabulary comes from."""

    LOGGED = 0
    MIRRORED = 1
    MADE = 2


@dataclass(frozen=True, slots=True)
class MotionSpace:
    """Motion of one agent type, compared by the corners of its box at the end."""

    agent_type: int
    limits: MotionLimits

    def points_m(self, items: Items) -> Float64[np.ndarray, "motion 4 2"]:
        """Return the box corners at the ends of motion tokens."""
        return box_corners(items[:, -1].astype(np.float64), BOX_LW_M[self.agent_type])

    def mean(self, items: Items) -> Float32[np.ndarray, "6 3"]:
        """Return the mean of motion; of headings the direction of the mean vector."""
        xy_m = items[..., :2].mean(axis=0, dtype=np.float64)
        heading = items[..., 2].astype(np.float64)
        heading = np.arctan2(np.sin(heading).mean(axis=0), np.cos(heading).mean(axis=0))
        return np.column_stack([xy_m, heading]).astype(np.float32)

    def allowed(self, items: Items) -> Bool[np.ndarray, " motion"]:
        """Tell which motion tokens keep to the limits."""
        return keeps_limits(items, self.agent_type, self.limits)


@dataclass(frozen=True, slots=True)
class MapSpace:
    """Pieces of polylines, compared by their middle and last points."""

    def points_m(self, items: Items) -> Float64[np.ndarray, "map_token 2 2"]:
        """Return the points that pieces are matched by, but for the first."""
        return items[:, list(MAP_SAMPLE_POINTS[1:])].astype(np.float64)

    def mean(self, items: Items) -> Float32[np.ndarray, "11 2"]:
        """Return the mean of pieces. As theirs do, its first interval lies along +x."""
        return items.mean(axis=0, dtype=np.float64).astype(np.float32)

    def allowed(self, items: Items) -> Bool[np.ndarray, " map_token"]:
        """Allow every piece."""
        return np.ones(len(items), dtype=bool)


@dataclass(slots=True)
class _VocabularyBuilder:
    """A vocabulary under construction."""

    space: Space
    count: int
    rows: Items
    origin: list[Origin] = field(default_factory=list)

    @property
    def room(self) -> int:
        """How many rows are still free."""
        return self.count - len(self.rows)

    def lay(
        self,
        items: Items,
        order: np.ndarray | None,
        tolerance_m: float,
        *,
        origin: Origin,
        spare: int = 0,
    ) -> None:
        """Lay disks on items until only ``spare`` rows are free. No order: as they come."""
        laid = find_disks(
            self.space,
            items,
            np.arange(len(items)) if order is None else order,
            tolerance_m,
            max(0, self.room - spare),
            self.rows,
            average=order is not None,
        )
        self.rows = np.concatenate([self.rows, laid])
        self.origin += [origin] * len(laid)

    def cover(
        self,
        logged: Items,
        order: np.ndarray,
        tolerance_m: float,
        rare: float,
        spare: int = 0,
    ) -> None:
        """Cover logged items: the common finely, the rare at ``rare`` times as roughly."""
        kept = spare + int((self.room - spare) * RARE_SHARE)
        for radius_m, left in ((tolerance_m, kept), (tolerance_m * rare, spare)):
            self.lay(logged, order, radius_m, origin=Origin.LOGGED, spare=left)

    def fill(
        self,
        logged: Items,
        order: np.ndarray,
        tolerance_m: float,
        mirrored: Items,
        made: Callable[[float], Items],
    ) -> None:
        """Fill all rows: what logs still give, mirror images, shapes made by rule.

        If all that is not enough, then the same again at ever less tolerance.
        """
        self.lay(logged, order, tolerance_m, origin=Origin.LOGGED)
        self.lay(mirrored, order[: len(mirrored)], tolerance_m, origin=Origin.MIRRORED)
        apart_m = tolerance_m * COARSEST_FACTOR
        while self.room:
            self.lay(made(apart_m / 2), None, apart_m, origin=Origin.MADE)
            apart_m /= 2
            if apart_m < tolerance_m:
                self.lay(logged, order, apart_m, origin=Origin.LOGGED)
                self.lay(mirrored, order[: len(mirrored)], apart_m, origin=Origin.MIRRORED)


def cluster_motion(
    segments: MotionSamples, settings: VocabSettings
) -> tuple[MotionVocabulary, Int8[np.ndarray, "3 motion"]]:
    """Make the motion vocabulary from segments of logs (which may be none).

    Returns:
        The vocabulary, and the ``Origin`` of its motion tokens.
    """
    agent_types = [
        _cluster_agent_type(segments.of_agent_type(agent_type), agent_type, settings)
        for agent_type in range(NUM_AGENT_TYPES)
    ]
    origin = np.array([builder.origin for builder in agent_types], dtype=np.int8)
    path = np.stack([builder.rows for builder in agent_types])
    return MotionVocabulary(BOX_LW_M, path, origin == Origin.LOGGED), origin


def cluster_map(
    curve_m: Float32[np.ndarray, "piece 11 2"], settings: VocabSettings
) -> tuple[MapVocabulary, Int8[np.ndarray, " map_token"], float]:
    """Make the map vocabulary from pieces of lines (which may be none).

    Returns:
        The vocabulary, the ``Origin`` of its shapes, and the tolerance it was made with.
    """
    logged, space = _distinct(curve_m), MapSpace()
    order = np.random.default_rng(settings.seed).permutation(len(logged))
    tolerance_m = settings.map_tolerance_m
    if tolerance_m == 0:
        tolerance_m = _search_tolerance(space, logged, order, settings.num_map_tokens)
    builder = _VocabularyBuilder(space, settings.num_map_tokens, logged[:0])
    builder.cover(logged, order, tolerance_m, RARE_MAP_FACTOR)
    mirrored = logged * np.array([1, -1], np.float32) if settings.mirror else logged[:0]
    builder.fill(logged, order, tolerance_m, mirrored, make_arcs)
    origin = np.array(builder.origin, dtype=np.int8)
    return MapVocabulary(builder.rows, origin == Origin.LOGGED), origin, tolerance_m


def _cluster_agent_type(
    path: Float32[np.ndarray, "segment 6 3"], agent_type: int, settings: VocabSettings
) -> _VocabularyBuilder:
    """Build the vocabulary of one agent type; its first row is stationary."""
    limits = motion_limits(settings)
    space, logged = MotionSpace(agent_type, limits), _distinct(path)
    order = np.random.default_rng((settings.seed, agent_type)).permutation(len(logged))
    mirrored = logged * np.array([1, -1, -1], np.float32)
    mirrored = mirrored if settings.mirror else mirrored[:0]

    still = np.zeros((1, *path.shape[1:]), np.float32)
    builder = _VocabularyBuilder(space, settings.num_motion_tokens, still, [Origin.MADE])
    anchors = _anchors(space, logged, int(settings.num_motion_tokens * MAX_ANCHOR_SHARE))
    tolerance_m = settings.tolerance_m
    builder.cover(logged, order, tolerance_m, RARE_MOTION_FACTOR, spare=len(anchors))
    builder.lay(anchors, None, tolerance_m, origin=Origin.MADE)
    builder.fill(
        logged,
        order,
        tolerance_m,
        mirrored,
        lambda apart_m: make_fan(agent_type, limits, apart_m),
    )
    return builder


def _anchors(space: MotionSpace, logged: Items, most: int) -> Items:
    """Make the most ordinary of the motion tokens that logs show nothing like."""
    made = make_fan(space.agent_type, space.limits, MADE_ANCHOR_M / 4)
    still = np.zeros((1, *made.shape[1:]), np.float32)
    order = np.arange(len(made))
    sparse = find_disks(space, made, order, MADE_ANCHOR_M, len(made), still, average=False)
    logged_m = space.points_m(logged)
    lonely = [
        not (mean_gap_m(logged_m, point_m) <= MADE_ANCHOR_M).any()
        for point_m in space.points_m(sparse)
    ]
    return sparse[np.array(lonely, dtype=bool)][:most]


def _search_tolerance(
    space: MapSpace, logged: Items, order: np.ndarray, count: int
) -> float:
    """Search the least tolerance at which so many disks cover all pieces."""
    low_m, high_m = MIN_MAP_TOLERANCE_M, MAX_MAP_TOLERANCE_M

    def suffices(tolerance_m: float) -> bool:
        builder = _VocabularyBuilder(space, count + 1, logged[:0])
        builder.cover(logged, order, tolerance_m, RARE_MAP_FACTOR)
        return builder.room > 0

    if suffices(low_m):
        return low_m
    for _ in range(_BISECTIONS):
        middle_m = (low_m * high_m) ** 0.5
        low_m, high_m = (low_m, middle_m) if suffices(middle_m) else (middle_m, high_m)
    return high_m


def _distinct(items: Items) -> Items:
    """Drop items that equal an earlier one to the millimetre."""
    if len(items) == 0:
        return items
    flat = np.round(items.reshape(len(items), -1) * 1000).astype(np.int32)
    return items[np.sort(np.unique(flat, axis=0, return_index=True)[1])]
