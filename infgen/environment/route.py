"""Routes: along the lanes of the map from where the ego is, drawn at random at forks."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from infgen.geometry import to_local
from infgen.scene import FeatureType, LaneType, LinkType, RoadMap, Scene

SPACING_M = 1.0
"""Between two points of a route."""
NEAR_LANE_M = 5.0
"""A route begins in a lane within this distance of the ego ..."""
ALONG_RAD = np.pi / 3
"""... whose direction differs by less."""
OFF_LANE_PER_RAD_M = 5.0
"""Among lanes, a turn counts as so many metres of distance."""
BACK_M, AHEAD_M = 20.0, 50.0
"""The ego is looked for on its route so far behind and ahead of where it was."""
END_M = 2.0
"""A route is driven to its end when so little is left."""


@dataclass(frozen=True, slots=True)
class Route:
    """A line that the ego is to follow.

    Attributes:
        xy_m: Its points, ``SPACING_M`` apart, in the frame of the scene.
    """

    xy_m: Float64[np.ndarray, "point 2"]

    @property
    def length_m(self) -> float:
        """Length."""
        return SPACING_M * (len(self.xy_m) - 1)

    def find(
        self, xy_m: Float64[np.ndarray, "2"], near_m: float | None = None
    ) -> tuple[float, float]:
        """Find the point of the route that is nearest.

        Args:
            xy_m: To this point.
            near_m: Where the search begins, as a way along the route; None looks at all.

        Returns:
            Way along the route, and how far the route is.
        """
        first, last = 0, len(self.xy_m) - 1
        if near_m is not None:
            first = min(max(0, int((near_m - BACK_M) / SPACING_M)), last - 1)
            last = min(last, int((near_m + AHEAD_M) / SPACING_M) + 1)
        start_m = self.xy_m[first:last]
        along = self.xy_m[first + 1 : last + 1] - start_m
        away = xy_m - start_m
        length2 = np.maximum((along**2).sum(axis=1), 1e-9)
        share = np.clip((away * along).sum(axis=1) / length2, 0, 1)
        gap_m = np.linalg.norm(away - share[:, None] * along, axis=1)
        best = int(gap_m.argmin())
        return SPACING_M * (first + best + float(share[best])), float(gap_m[best])

    def at(self, way_m: Float64[np.ndarray, " way"]) -> Float64[np.ndarray, "way 2"]:
        """Return points at ways along the route; its end beyond that."""
        number = np.arange(len(self.xy_m)) * SPACING_M
        return np.stack([np.interp(way_m, number, line) for line in self.xy_m.T], axis=-1)


def make_route(
    scene: Scene, random: np.random.Generator, length_m: float, step: int
) -> Route:
    """Make a route that begins at the ego.

    At each fork one of the lanes is drawn. Where the ego is in no lane the route is the
    way that was logged, or straight ahead.

    Args:
        scene: The log.
        random: Decides at forks.
        length_m: Greatest length.
        step: Step of the log at which the ego is looked at.
    """
    pose = scene.tracks.pose(step)[scene.ego].astype(np.float64)
    lane = _find_lane(scene.road_map, pose)
    if lane is None:
        return Route(_resample(_logged_way(scene, pose, step), length_m))
    number = int(random.integers(2**63))  # One draw, however long the route.
    line_m = _follow_lanes(scene.road_map, lane, np.random.default_rng(number), length_m)
    whole = Route(_resample(line_m, np.inf))
    way_m, _ = whole.find(pose[:2])
    return Route(_resample(whole.xy_m[int(way_m) :], length_m))


def _find_lane(road_map: RoadMap, pose: Float64[np.ndarray, "3"]) -> int | None:
    """Row of the lane that the ego drives in; None if it drives in none."""
    best, best_m = None, np.inf
    for row in road_map.rows(FeatureType.LANE).tolist():
        line_m = road_map.points(row)[:, :2].astype(np.float64)
        if road_map.feature_subtype[row] == LaneType.BIKE_LANE or len(line_m) < 2:
            continue
        way = np.diff(line_m, axis=0)
        frame = np.column_stack([line_m[:-1], np.arctan2(way[:, 1], way[:, 0])])
        ahead_m, aside_m, turn_rad = to_local(np.broadcast_to(pose, frame.shape), frame).T
        beyond_m = np.maximum(ahead_m - np.linalg.norm(way, axis=1), -ahead_m).clip(min=0)
        gap_m, turn_rad = np.hypot(beyond_m, aside_m), np.abs(turn_rad)
        cost_m = gap_m + OFF_LANE_PER_RAD_M * turn_rad
        cost_m[(gap_m > NEAR_LANE_M) | (turn_rad > ALONG_RAD)] = np.inf
        if cost_m.min() < best_m:
            best, best_m = row, float(cost_m.min())
    return best


def _follow_lanes(
    road_map: RoadMap, lane: int, random: np.random.Generator, length_m: float
) -> Float64[np.ndarray, "point 2"]:
    """Points of the lane and of those that follow, until they are long enough or end."""
    row_of = {int(number): row for row, number in enumerate(road_map.feature_id)}
    exits = road_map.link_type == LinkType.EXIT
    lines, so_far_m = [], 0.0
    while True:
        line_m = road_map.points(lane)[:, :2].astype(np.float64)
        lines.append(line_m)
        so_far_m += float(np.linalg.norm(np.diff(line_m, axis=0), axis=1).sum())
        own = exits & (road_map.link_lane_id == road_map.feature_id[lane])
        others = [
            row_of[number]
            for number in road_map.link_other_id[own].tolist()
            if number in row_of and len(road_map.points(row_of[number])) > 1
        ]
        # The first lane may lie behind the ego with all of its length.
        reached_m = so_far_m - float(
            np.linalg.norm(np.diff(lines[0], axis=0), axis=1).sum()
        )
        if not others or reached_m >= length_m:
            return np.concatenate(lines)
        lane = others[int(random.integers(len(others)))]


def _logged_way(
    scene: Scene, pose: Float64[np.ndarray, "3"], step: int
) -> Float64[np.ndarray, "point 2"]:
    """Where the log leads from a step on, and 50 m straight on from its end."""
    seen = scene.tracks.valid[scene.ego, step:]
    way_m = scene.tracks.xyz_m[scene.ego, step:, :2][seen].astype(np.float64)
    end = scene.tracks.heading_rad[scene.ego, step:][seen][-1]
    ahead_m = way_m[-1] + AHEAD_M * np.array([np.cos(end), np.sin(end)])
    return np.concatenate([pose[None, :2], way_m, ahead_m[None]])


def _resample(
    line_m: Float64[np.ndarray, "point 2"], length_m: float
) -> Float64[np.ndarray, "even 2"]:
    """Points at even distances along a line; at least two."""
    steps_m = np.linalg.norm(np.diff(line_m, axis=0), axis=1)
    along_m = np.concatenate([[0.0], steps_m.cumsum()])
    count = max(1, int(min(along_m[-1], length_m) / SPACING_M))
    at_m = SPACING_M * np.arange(count + 1)
    return np.stack([np.interp(at_m, along_m, line) for line in line_m.T], axis=-1)
