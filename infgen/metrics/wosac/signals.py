"""Running a red light: crossing the stop line of one's lane while it shows stop.

The definition is the official metric's, with its two oddities, which decide results:
the search for the nearest lane measures to the mirror image of a point (it adds the step
along the segment where it should subtract it), and it takes part of the padding for a
segment: from the last point of every lane but the longest to the world's zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int64

from infgen.metrics.motion import Motion
from infgen.scene import SignalState
from infgen.spatial.road_edges import project

RED = (SignalState.ARROW_STOP, SignalState.STOP)
"""States that forbid to cross; a flashing stop does not."""
PAIRS_PER_BLOCK = 1 << 18


@dataclass(frozen=True, slots=True)
class StopLines:
    """Lanes of surface streets, and the signals that speak to them.

    Segments are lane by lane, the padding's among them (``real`` False).

    Attributes:
        start_m: First point of each segment.
        along_m: From the first point to the last.
        lane: Row of the segment's lane.
        real: Whether the segment is part of the lane.
        signal_lane: Row of each signal's lane.
        red: Whether the signal forbids to cross.
        line_start_m: First point of the lane segment that holds the stop point.
        line_along_m: Along that segment.
        line_share: Where on that segment the stop point lies.
    """

    start_m: Float32[np.ndarray, "segment 2"]
    along_m: Float32[np.ndarray, "segment 2"]
    lane: Int64[np.ndarray, " segment"]
    real: Bool[np.ndarray, " segment"]
    signal_lane: Int64[np.ndarray, " signal"]
    red: Bool[np.ndarray, "signal step"]
    line_start_m: Float32[np.ndarray, "signal step 2"]
    line_along_m: Float32[np.ndarray, "signal step 2"]
    line_share: Float32[np.ndarray, "signal step"]


def build_stop_lines(
    lane_id: Int64[np.ndarray, " lane"],
    lanes_m: Sequence[Float32[np.ndarray, "_ 3"]],
    signal_lane_id: Int64[np.ndarray, " signal"],
    state: Int8[np.ndarray, "signal step"],
    stop_m: Float32[np.ndarray, "signal step 2"],
) -> StopLines:
    """Find the lane segment that each signal's stop point lies on, step by step.

    Args:
        lane_id: Ids of the surface-street lanes, of two or more points each.
        lanes_m: Their points.
        signal_lane_id: Lane that each signal speaks to; signals of other lanes are dropped.
        state: ``SignalState``; unknown (0) where the log has none.
        stop_m: Stop points; zero where the log has none.
    """
    start_m, along_m, lane, real = _segments(lanes_m)
    rows = {int(i): row for row, i in reversed(list(enumerate(lane_id)))}
    known = np.array([int(i) in rows for i in signal_lane_id], dtype=bool)
    signal_lane = np.array(
        [rows[int(i)] for i in signal_lane_id[known]], dtype=np.int64
    ).reshape(-1)
    line_start_m = np.zeros((len(signal_lane), *stop_m.shape[1:]), dtype=np.float32)
    line_along_m = np.zeros_like(line_start_m)
    for signal, row in enumerate(signal_lane):
        own = np.flatnonzero((lane == row) & real)
        gap_m = _mirrored_m(stop_m[known][signal], start_m[own], along_m[own])
        nearest = own[gap_m.argmin(axis=1)]  # [step]
        line_start_m[signal], line_along_m[signal] = start_m[nearest], along_m[nearest]
    return StopLines(
        start_m=start_m,
        along_m=along_m,
        lane=lane,
        real=real,
        signal_lane=signal_lane,
        red=np.isin(state[known], RED),
        line_start_m=line_start_m,
        line_along_m=line_along_m,
        line_share=project(stop_m[known] - line_start_m, line_along_m),
    )


def runs_red_light(
    motion: Motion, evaluated: Int64[np.ndarray, " object"], lines: StopLines
) -> Bool[np.ndarray, "rollout object step"]:
    """Whether each evaluated box crosses a red stop line of its lane at each step.

    Steps are those of ``lines``. A box crosses at a step if it was before the stop point a
    step ago and is past it now, each measured along the lane at that step.
    """
    xy_m = np.stack([motion.x_m[:, evaluated], motion.y_m[:, evaluated]], axis=-1)
    crossed = np.zeros(xy_m.shape[:3], dtype=bool)
    events: list[np.ndarray] = []
    for signal in range(len(lines.signal_lane)):
        share = project(xy_m - lines.line_start_m[signal], lines.line_along_m[signal])
        before, after = share < lines.line_share[signal], share > lines.line_share[signal]
        now = before[..., :-1] & after[..., 1:] & lines.red[signal, 1:]
        now &= motion.valid[:, evaluated, 1:]
        rollout, one, step = np.nonzero(now)
        events.append(np.stack([rollout, one, step + 1, np.full(len(one), signal)]))
    if not events:
        return crossed
    rollout, one, step, signal = np.concatenate(events, axis=1)
    lane = _nearest_lane(xy_m[rollout, one, step], lines)
    hit = lane == lines.signal_lane[signal]
    crossed[rollout[hit], one[hit], step[hit]] = True
    return crossed


def _segments(
    lanes_m: Sequence[np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Start, along, lane row and realness of all segments, the padding's among them."""
    longest = max((len(line_m) for line_m in lanes_m), default=0)
    starts, alongs, lanes, reals = [np.zeros((0, 2), np.float32)], [], [], []
    for row, line_m in enumerate(lanes_m):
        end_m = np.zeros((1, 2), dtype=np.float32)
        points_m = line_m[:, :2]
        if len(line_m) < longest:
            points_m = np.concatenate([points_m, end_m])
        starts.append(points_m[:-1])
        alongs.append(np.diff(points_m, axis=0))
        lanes.append(np.full(len(points_m) - 1, row, dtype=np.int64))
        reals.append(np.arange(len(points_m) - 1) < len(line_m) - 1)
    alongs.append(np.zeros((0, 2), np.float32))
    lanes.append(np.zeros(0, np.int64))
    reals.append(np.zeros(0, bool))
    return tuple(np.concatenate(part) for part in (starts, alongs, lanes, reals))  # type: ignore[return-value]


def _nearest_lane(
    points_m: Float32[np.ndarray, "point 2"], lines: StopLines
) -> Int64[np.ndarray, " point"]:
    """Row of the lane that is nearest in the official sense; the first of equals."""
    lane = np.zeros(len(points_m), dtype=np.int64)
    size = max(1, PAIRS_PER_BLOCK // len(lines.lane))
    for start in range(0, len(points_m), size):
        some = slice(start, start + size)
        gap_m = _mirrored_m(points_m[some], lines.start_m, lines.along_m)
        lane[some] = lines.lane[gap_m.argmin(axis=1)]
    return lane


def _mirrored_m(
    points_m: Float32[np.ndarray, "point 2"],
    start_m: Float32[np.ndarray, "segment 2"],
    along_m: Float32[np.ndarray, "segment 2"],
) -> Float32[np.ndarray, "point segment"]:
    """Distance of points to segments, with the official sign error."""
    to_point_m = points_m[:, None] - start_m
    share = np.clip(project(to_point_m, along_m), 0, 1)
    x_m, y_m = np.moveaxis(to_point_m + along_m * share[..., None], -1, 0)
    return np.sqrt(x_m * x_m + y_m * y_m)
