"""A source of one's own in three functions: logs as JSON files, a scene in each.

`docs/own-source.md` explains it. A file holds `{"id", "split", "ego", "agents"}`; an agent
is `{"name", "xy_m": [[x, y], ...], "heading_rad": [...], "size_lwh_m": [l, w, h]}`.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from infgen.clock import CLOCK
from infgen.scene import AgentType, FeatureType, LaneType, Scene, Signals
from infgen.sources.ids import integer_ids
from infgen.sources.map_builder import MapBuilder
from infgen.sources.scene_files import Label, ReadScene, SceneFiles, read_bytes, short_name
from infgen.sources.tfrecord import RecordError
from infgen.sources.womd_tracks import WorldTracks, origin_near

MARK = b'{"format": "own-logs"'
NOW = 10


def find(folder: Path, names: Sequence[str]) -> list[SceneFiles]:
    """Find the logs of a folder by their first bytes."""
    return [
        SceneFiles(short_name(folder / name), (str(folder / name),))
        for name in names
        if name.endswith(".json") and (folder / name).read_bytes().startswith(MARK)
    ]


def label(files: SceneFiles) -> Label:
    """Tell split and id; must not raise, for damage is named by ``read``."""
    try:
        log = _log(files)
    except RecordError:
        return Label("training", Path(files.paths[0]).stem)
    return Label(str(log["split"]), str(log["id"]))


def read(files: SceneFiles, now: int | None) -> ReadScene:
    """Turn one log into a scene, or say by ``RecordError`` why it is none."""
    log, now = _log(files), NOW if now is None else now
    tracks = _tracks(log["agents"])
    names = [agent["name"] for agent in log["agents"]]
    ego, num_steps = names.index(log["ego"]), tracks.valid.shape[1]
    origin_xyz_m = origin_near(tracks, ego, now)
    scene = Scene(
        scenario_id=str(log["id"]),
        origin_xyz_m=origin_xyz_m,
        timestamps_s=CLOCK.step_s * np.arange(num_steps),
        now=now,
        ego=ego,
        predict_row=np.array([ego], np.int32),
        predict_difficulty=np.zeros(1, np.int8),
        interest_id=np.zeros(0, np.int32),
        tracks=tracks.around(origin_xyz_m),
        road_map=_road().build(origin_xyz_m),
        signals=Signals(
            step=np.zeros(0, np.int16),
            lane_id=np.zeros(0, np.int64),
            state=np.zeros(0, np.int8),
            stop_xyz_m=np.zeros((0, 3), np.float32),
        ),
        lights_recorded=False,  # Else a scene without lights would count as one.
    )
    return ReadScene(scene, "own-logs", annotation_hz=10.0)


def _log(files: SceneFiles) -> dict[str, Any]:
    try:
        log: dict[str, Any] = json.loads(read_bytes(files.paths[0]))
    except ValueError as error:
        raise RecordError(f"not JSON: {error}") from error
    if missing := {"id", "split", "ego", "agents"} - log.keys():
        raise RecordError(f"log lacks {', '.join(sorted(missing))}")
    return log


def _tracks(agents: list[dict[str, Any]]) -> WorldTracks:
    """All agents, seen at all steps; types are WOMD's, one more than ``AgentType``."""
    xy_m = np.array([agent["xy_m"] for agent in agents], np.float64)
    size_lwh_m = np.array([agent["size_lwh_m"] for agent in agents], np.float32)
    heading_rad = np.array([agent["heading_rad"] for agent in agents], np.float32)
    height_m = np.broadcast_to(size_lwh_m[:, None, 2:] / 2, (*xy_m.shape[:2], 1))
    ids = integer_ids([agent["name"] for agent in agents], 2**31 - 1)
    return WorldTracks(
        id=np.array(list(ids.values()), np.int32),
        type=np.full(len(agents), AgentType.VEHICLE + 1, np.int32),
        xyz_m=np.concatenate([xy_m, height_m], axis=-1),
        heading_rad=heading_rad,
        velocity_mps=(np.gradient(xy_m, axis=1) / CLOCK.step_s).astype(np.float32),
        size_lwh_m=np.broadcast_to(size_lwh_m[:, None], (*xy_m.shape[:2], 3)),
        valid=np.ones(xy_m.shape[:2], bool),
    )


def _road() -> MapBuilder:
    """One lane along +x; a real source reads its map here."""
    x_m = np.arange(-50.0, 150.0)
    road = MapBuilder()
    line_m = np.column_stack([x_m, 0 * x_m, 0 * x_m])
    road.feature(1, FeatureType.LANE, LaneType.SURFACE_STREET, line_m)
    road.feature(2, FeatureType.ROAD_EDGE, 1, line_m - np.array([0.0, 3.0, 0.0]))
    return road
