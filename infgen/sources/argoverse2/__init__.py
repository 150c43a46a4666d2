"""Argoverse 2: motion forecasting scenarios and sensor logs, a folder each -> ``Scene``.

``find``, ``label`` and ``read`` are the way in (``scene_files.SceneSource``). No package of
Argoverse is needed.
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from infgen.clock import CLOCK
from infgen.scene import RoadMap, Scene, SceneError, Signals
from infgen.sources.argoverse2 import motion, sensor
from infgen.sources.argoverse2.roads import read_map
from infgen.sources.map_builder import MapBuilder
from infgen.sources.scene_files import (
    NEAR_FOLDERS,
    Label,
    ReadScene,
    SceneFiles,
    read_bytes,
    read_head,
    short_name,
    split_in,
)
from infgen.sources.tfrecord import RecordError
from infgen.sources.womd_tracks import WorldTracks, origin_near

POSES, ANNOTATIONS = "city_SE3_egovehicle.feather", "annotations.feather"
MAP_FOLDER = "map"
_PARQUET = b"PAR1"
_SCENARIO, _TABLE = "scenario_", ".parquet"
_ANNOTATION_HZ = 10.0


def find(folder: Path, names: Sequence[str]) -> list[SceneFiles]:
    """Tell whether a folder is a scenario or a log: a folder holds one at most.

    A scenario has a Parquet table and a map beside it, a sensor log Feather tables of boxes
    and poses, and its map in the folder ``map``.
    """
    maps = _maps(names)
    tables = [name for name in names if _is_parquet(folder, name, maps)]
    if len(tables) == 1:
        return [_files(folder, [tables[0], *maps[:1]])]
    tables = [name for name in (ANNOTATIONS, POSES) if name in names]
    if tables:
        inner = folder / MAP_FOLDER
        maps = _maps(sorted(os.listdir(inner)) if inner.is_dir() else ())
        return [_files(folder, [*tables, *(f"{MAP_FOLDER}/{name}" for name in maps[:1])])]
    return []


def _is_parquet(folder: Path, name: str, maps: Sequence[str]) -> bool:
    """Tell a scenario's table by its content; a damaged one by its name."""
    if name.startswith(_SCENARIO) and name.endswith(_TABLE):
        return True
    return bool(maps) and read_head(folder / name).startswith(_PARQUET)


def label(files: SceneFiles) -> Label:
    """Tell split and id by the folders: Argoverse names them so."""
    folder = Path(files.paths[0]).parent
    above = folder.parts[-1 - NEAR_FOLDERS : -1]
    return Label(split_in(above) or "argoverse2", folder.name)


def read(files: SceneFiles, now: int | None) -> ReadScene:
    """Read one scenario or log.

    Raises:
        RecordError: if a file is missing or damaged, or it is no scene that can be used.
        OSError: if a file cannot be read.
    """
    paths = {Path(path).name: path for path in files.paths}
    maps = [paths[name] for name in _maps(paths)]
    if not maps:
        raise RecordError("folder has no map archive (log_map_archive_*.json)")
    if not {ANNOTATIONS, POSES} & paths.keys():
        return decode_motion(read_bytes(files.paths[0]), read_bytes(maps[0]), now)
    for name in (ANNOTATIONS, POSES):
        if name not in paths:
            raise RecordError(f"folder has no {name}")
    tables = [read_bytes(paths[name]) for name in (ANNOTATIONS, POSES)]
    name = Path(files.paths[0]).parent.name
    return decode_sensor(name, tables[0], tables[1], read_bytes(maps[0]), now)


def decode_motion(table: bytes, archive: bytes, now: int | None = None) -> ReadScene:
    """Turn the two files of a motion forecasting scenario into a scene.

    Raises:
        RecordError: if they are no scene that can be used.
    """
    road_map, ground = read_map(archive)
    log = motion.read_motion(table, ground)
    now = motion.NOW if now is None else now
    roles = (log.predict_row.astype(np.int32), log.focal_id.astype(np.int32))
    scene = _scene(log.scenario_id, log.tracks, log.ego, now, roles, road_map)
    return ReadScene(scene, "av2-motion", _ANNOTATION_HZ)


def decode_sensor(
    log_id: str, annotations: bytes, poses: bytes, archive: bytes, now: int | None = None
) -> ReadScene:
    """Turn the three files of a sensor log into a scene.

    Raises:
        RecordError: if they are no scene that can be used.
    """
    road_map, _ = read_map(archive)
    tracks = sensor.read_sensor(annotations, poses)
    now = sensor.NOW if now is None else now
    roles = (np.zeros(0, np.int32), np.zeros(0, np.int32))
    scene = _scene(log_id, tracks, 0, now, roles, road_map)
    return ReadScene(scene, "av2-sensor", _ANNOTATION_HZ)


def _scene(
    scenario_id: str,
    tracks: WorldTracks,
    ego: int,
    now: int,
    roles: tuple[np.ndarray, np.ndarray],
    road_map: MapBuilder,
) -> Scene:
    num_steps = tracks.valid.shape[1]
    if not 0 <= now < num_steps:
        raise RecordError(f"current step {now} is not one of the {num_steps} steps")
    if not scenario_id:
        raise RecordError("scenario id is empty")
    origin_xyz_m = origin_near(tracks, ego, now)
    built: RoadMap = road_map.build(origin_xyz_m)
    try:
        return Scene(
            scenario_id=scenario_id,
            origin_xyz_m=origin_xyz_m,
            timestamps_s=CLOCK.step_s * np.arange(num_steps),
            now=now,
            ego=ego,
            predict_row=roles[0],
            predict_difficulty=np.zeros(len(roles[0]), np.int8),
            interest_id=roles[1],
            tracks=tracks.around(origin_xyz_m),
            road_map=built,
            signals=_no_signals(),
            lights_recorded=False,
        )
    except SceneError as error:
        raise RecordError(f"not a usable log: {error}") from error


def _no_signals() -> Signals:
    """Argoverse 2 has no traffic lights."""
    return Signals(
        step=np.zeros(0, np.int16),
        lane_id=np.zeros(0, np.int64),
        state=np.zeros(0, np.int8),
        stop_xyz_m=np.zeros((0, 3), np.float32),
    )


def _files(folder: Path, names: Iterable[str]) -> SceneFiles:
    return SceneFiles(short_name(folder), tuple(str(folder / name) for name in names))


def _maps(names: Iterable[str]) -> list[str]:
    """Map archives of a folder: JSON, and not the pose of its raster image."""
    return [name for name in names if name.endswith(".json") and "Sim2" not in name]
