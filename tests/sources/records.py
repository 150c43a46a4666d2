"""Hand-made ``Scenario`` messages and TFRecord files."""

import gzip
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from infgen.sources.tfrecord import frame
from tests.sources.scenario_proto import Scenario

STEPS = 12
NOW = 4
SHARED = Path(__file__).parents[2] / ".." / "shared" / "data" / "womd"


def small_scenario(scenario_id: str = "small", steps: int = STEPS) -> Any:
    """Build a sound message: two agents, every kind of map feature, a light.

    The ego drives along +x at 10 m/s past (1000.5, -2000.25, 30.125) now; the pedestrian
    (row 1) is seen from step 2 on.
    """
    message = Scenario(scenario_id=scenario_id, current_time_index=NOW, sdc_track_index=0)
    message.timestamps_seconds.extend(0.1 * step for step in range(steps))
    _add_track(message, 7, 1, steps, seen_from=0, speed_mps=10.0)
    _add_track(message, 9, 2, steps, seen_from=2, speed_mps=1.5)
    message.tracks_to_predict.add(track_index=1, difficulty=2)
    message.objects_of_interest.extend([9, 7])
    for _ in range(steps):
        light = message.dynamic_map_states.add().lane_states.add(lane=100, state=4)
        _set(light.stop_point, 1010.0, -2000.0, 30.0)
    _add_map(message)
    return message


def _add_track(message, track_id, kind, steps, *, seen_from, speed_mps) -> None:
    track = message.tracks.add(id=track_id, object_type=kind)
    for step in range(steps):
        if step < seen_from:
            track.states.add(center_x=0.0, valid=False)
            continue
        track.states.add(
            center_x=1000.5 + 0.1 * speed_mps * (step - NOW),
            center_y=-2000.25 + 3.0 * (track_id - 7),
            center_z=30.125,
            length=4.5,
            width=2.0,
            height=1.5,
            heading=0.25,
            velocity_x=speed_mps,
            velocity_y=0.0,
            valid=True,
        )


def _add_map(message) -> None:
    for feature_id, lane_type in ((100, 2), (101, 3)):
        lane = message.map_features.add(id=feature_id).lane
        lane.speed_limit_mph, lane.type, lane.interpolating = 25.0, lane_type, True
        _line(lane.polyline, 3 + feature_id - 100, feature_id)
    first = message.map_features[0].lane
    first.entry_lanes.extend([98, 99])
    first.exit_lanes.append(200)
    first.left_neighbors.add(
        feature_id=101,
        self_start_index=0,
        self_end_index=2,
        neighbor_start_index=1,
        neighbor_end_index=3,
    ).boundaries.add(
        lane_start_index=0, lane_end_index=1, boundary_feature_id=300, boundary_type=7
    )
    first.right_boundaries.add(
        lane_start_index=1, lane_end_index=2, boundary_feature_id=301
    )
    line = message.map_features.add(id=300).road_line
    line.type = 7
    _line(line.polyline, 4, 300)
    edge = message.map_features.add(id=301).road_edge
    edge.type = 1
    _line(edge.polyline, 5, 301)
    sign = message.map_features.add(id=400).stop_sign
    sign.lane.extend([100, 101])
    _set(sign.position, 1005.0, -1999.0, 31.0)
    _line(message.map_features.add(id=500).crosswalk.polygon, 4, 500)
    _line(message.map_features.add(id=600).speed_bump.polygon, 4, 600)
    _line(message.map_features.add(id=700).driveway.polygon, 4, 700)


def _line(points, count: int, seed: int) -> None:
    for i in range(count):
        _set(points.add(), 1000.0 + i, -2000.0 + math.sin(seed + i), 30.0)


def _set(point, x: float, y: float, z: float) -> None:
    point.x, point.y, point.z = x, y, z


def changed(change: Callable[[Any], None], scenario_id: str = "small") -> bytes:
    """Bytes of the small scenario after a change."""
    message = small_scenario(scenario_id)
    change(message)
    return message.SerializeToString()


def write_tfrecord(path: Path, records: Iterable[bytes]) -> Path:
    """Write a TFRecord; gzipped if its name says so."""
    data = b"".join(frame(record) for record in records)
    path.write_bytes(gzip.compress(data, 1) if path.suffix == ".gz" else data)
    return path
