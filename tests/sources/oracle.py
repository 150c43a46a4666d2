"""What a ``Scene`` must be, written with protobuf and loops: slow, plain, independent."""

import numpy as np

from infgen.scene import RoadMap, Scene, Signals, Tracks

KINDS = {
    "lane": (3, "polyline"),
    "road_line": (4, "polyline"),
    "road_edge": (5, "polyline"),
    "stop_sign": (7, None),
    "crosswalk": (8, "polygon"),
    "speed_bump": (9, "polygon"),
    "driveway": (10, "polygon"),
}


def local(points, origin) -> np.ndarray:
    """Points (with x, y, z) as float32 around an origin."""
    world = np.array([(p.x, p.y, p.z) for p in points], np.float64).reshape(-1, 3)
    return (world - origin).astype(np.float32)


def expected_scene(message) -> Scene:
    """Build the scene of a sound ``Scenario``."""
    now = message.current_time_index
    ego = message.tracks[message.sdc_track_index].states[now]
    origin = np.round([ego.center_x, ego.center_y, ego.center_z]) + 0.0
    return Scene(
        scenario_id=message.scenario_id,
        origin_xyz_m=origin,
        timestamps_s=np.array(message.timestamps_seconds, np.float64),
        now=now,
        ego=message.sdc_track_index,
        predict_row=np.array([p.track_index for p in message.tracks_to_predict], np.int32),
        predict_difficulty=np.array(
            [p.difficulty for p in message.tracks_to_predict], np.int8
        ),
        interest_id=np.array(message.objects_of_interest, np.int32),
        tracks=expected_tracks(message, origin),
        road_map=expected_map(message, origin),
        signals=expected_signals(message, origin),
    )


def expected_tracks(message, origin) -> Tracks:
    names = "center_x center_y center_z heading velocity_x velocity_y length width height"
    rows = [
        [[getattr(state, name) for name in names.split()] for state in track.states]
        for track in message.tracks
    ]
    table = np.array(rows, np.float64)
    valid = [[state.valid for state in track.states] for track in message.tracks]
    return Tracks(
        id=np.array([t.id for t in message.tracks], np.int32),
        agent_type=np.array([(t.object_type or 4) - 1 for t in message.tracks], np.int8),
        xyz_m=(table[..., :3] - origin).astype(np.float32),
        heading_rad=table[..., 3].astype(np.float32),
        velocity_mps=table[..., 4:6].astype(np.float32),
        size_lwh_m=table[..., 6:9].astype(np.float32),
        valid=np.array(valid, bool),
    )


def expected_signals(message, origin) -> Signals:
    rows = [
        (step, light)
        for step, state in enumerate(message.dynamic_map_states)
        for light in state.lane_states
    ]
    return Signals(
        step=np.array([step for step, _ in rows], np.int16),
        lane_id=np.array([light.lane for _, light in rows], np.int64),
        state=np.array([light.state for _, light in rows], np.int8),
        stop_xyz_m=local([light.stop_point for _, light in rows], origin),
    )


def expected_map(message, origin) -> RoadMap:
    features, points, links, neighbours, boundaries, signs = [], [], [], [], [], []
    for feature in message.map_features:
        name = next((name for name in KINDS if feature.HasField(name)), None)
        if name is None:
            continue
        kind, line = KINDS[name]
        part = getattr(feature, name)
        own = getattr(part, line) if line else [part.position] * part.HasField("position")
        points.append(local(own, origin))
        row = (feature.id, kind, getattr(part, "type", 0))
        features.append((*row, getattr(part, "speed_limit_mph", 0.0)))
        features[-1] += (getattr(part, "interpolating", False),)
        if name == "stop_sign":
            signs += [(feature.id, lane) for lane in part.lane]
        if name == "lane":
            links += [(feature.id, 0, other) for other in part.entry_lanes]
            links += [(feature.id, 1, other) for other in part.exit_lanes]
            _relations(feature.id, part, neighbours, boundaries)
    columns = [list(zip(*rows, strict=True)) for rows in (features, links, neighbours)]
    ids, kinds, types, speeds, interpolating = columns[0] or [()] * 5
    link = columns[1] or [()] * 3
    neighbour = columns[2] or [()] * 4
    boundary = list(zip(*boundaries, strict=True)) or [()] * 6
    return RoadMap(
        feature_id=np.array(ids, np.int64),
        feature_type=np.array(kinds, np.int8),
        feature_subtype=np.array(types, np.int8),
        speed_limit_mph=np.array(speeds, np.float32),
        interpolating=np.array(interpolating, bool),
        point_offsets=np.cumsum([0, *map(len, points)]),
        xyz_m=np.concatenate([np.empty((0, 3), np.float32), *points]),
        link_lane_id=np.array(link[0], np.int64),
        link_type=np.array(link[1], np.int8),
        link_other_id=np.array(link[2], np.int64),
        neighbour_lane_id=np.array(neighbour[0], np.int64),
        neighbour_side=np.array(neighbour[1], np.int8),
        neighbour_other_id=np.array(neighbour[2], np.int64),
        neighbour_span=np.array(neighbour[3], np.int32).reshape(-1, 4),
        boundary_lane_id=np.array(boundary[0], np.int64),
        boundary_side=np.array(boundary[1], np.int8),
        boundary_feature_id=np.array(boundary[2], np.int64),
        boundary_type=np.array(boundary[3], np.int8),
        boundary_span=np.array(boundary[4], np.int32).reshape(-1, 2),
        boundary_neighbour=np.array(boundary[5], np.int32),
        sign_id=np.array([sign for sign, _ in signs], np.int64),
        sign_lane_id=np.array([lane for _, lane in signs], np.int64),
    )


def _relations(lane_id, lane, neighbours, boundaries) -> None:
    """Rows of a lane: neighbours with the boundaries to them, then its own boundaries."""

    def bound(side, segments, row):
        for s in segments:
            span = (s.lane_start_index, s.lane_end_index)
            fields = (s.boundary_feature_id, s.boundary_type, span, row)
            boundaries.append((lane_id, side, *fields))

    for side, found in ((0, lane.left_neighbors), (1, lane.right_neighbors)):
        for n in found:
            span = (n.self_start_index, n.self_end_index)
            span += (n.neighbor_start_index, n.neighbor_end_index)
            bound(side, n.boundaries, len(neighbours))
            neighbours.append((lane_id, side, n.feature_id, span))
    bound(0, lane.left_boundaries, -1)
    bound(1, lane.right_boundaries, -1)
