"""ScenarioNet and MetaDrive: scene files, one pickle per scene -> ``Scene``.

``find``, ``label`` and ``read`` are the way in (``scene_files.SceneSource``). The pickles
are read by ``pickles``, which runs nothing of them.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from infgen.clock import CLOCK
from infgen.scene import Scene, SceneError
from infgen.sources.ids import integer_name
from infgen.sources.scenarionet.datasets import (
    Convention,
    convention_of,
    dataset_of,
    split_of,
)
from infgen.sources.scenarionet.parts import (
    Part,
    integer_of,
    named_parts,
    part_of,
    sequence_of,
    text_of,
)
from infgen.sources.scenarionet.pickles import array, unpickle
from infgen.sources.scenarionet.roads import lane_ids, read_road_map
from infgen.sources.scenarionet.signals import read_signals
from infgen.sources.scenarionet.tracks import read_tracks, track_ids
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
from infgen.sources.womd import MAX_STEPS
from infgen.sources.womd_tracks import origin_near

NOW = 10
"""Last step of the history where a description does not say."""
ORIGIN = "infgen_origin_xyz_m"
"""In the metadata of what we wrote: the scene's origin, if it is not that of a reader."""
LIGHTS_RECORDED = "infgen_lights_recorded"
"""In the metadata of what we wrote: False where the scene's source records no lights."""
STEP_TOLERANCE_S = 0.02
_PROTOCOLS = (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")
_SUMMARIES = ("dataset_summary", "dataset_mapping")
"""First letters of ScenarioNet's own tables of a folder, which hold no scenes."""
_SUFFIXES = (".pkl", ".pickle")
_MAX_DIFFICULTY = 2
_MAX_ID_LETTERS = 200


def find(folder: Path, names: Sequence[str]) -> list[SceneFiles]:
    """Find the pickles of a folder but for ScenarioNet's own tables.

    They are told by their content; files that are only named so are found to be refused.
    """
    return [
        SceneFiles(short_name(folder / name), (str(folder / name),))
        for name in names
        if not name.startswith(_SUMMARIES)
        and (name.endswith(_SUFFIXES) or is_pickle(read_head(folder / name)))
    ]


def is_pickle(head: bytes) -> bool:
    """Tell whether a file starts as a pickle of protocol 2 or newer."""
    return head.startswith(_PROTOCOLS)


def label(files: SceneFiles) -> Label:
    """Tell split and id; of a damaged file what its name and folders say."""
    path = Path(files.paths[0])
    folders = path.parts[-1 - NEAR_FOLDERS : -1]
    try:
        description = _description(files)
        return Label(split_of(description, folders), _scenario_id(description))
    except (RecordError, OSError):
        return Label(split_in(folders) or "scenarionet", path.stem)


def read(files: SceneFiles, now: int | None) -> ReadScene:
    """Read one description.

    Raises:
        RecordError: if it is no description of a scene, or no scene that can be used.
        OSError: if the file cannot be read.
    """
    return decode(_description(files), now)


def decode(description: Part, now: int | None = None) -> ReadScene:
    """Turn a description, as ``unpickle`` gave it, into a scene.

    Raises:
        RecordError: if it is no scene that can be used.
    """
    about = part_of(description, "metadata", "description")
    dataset = dataset_of(about)
    convention = convention_of(dataset)
    tracks = named_parts(description, "tracks", "description")
    features = named_parts(description, "map_features", "description")
    timestamps_s = _timestamps(description, about)
    num_steps = len(timestamps_s)
    ego = _ego(about, tracks)
    world = read_tracks(tracks, num_steps, ego, convention)
    ego_row, now = list(tracks).index(ego), _now(about, now, num_steps)
    origin_xyz_m = _origin(about, origin_near(world, ego_row, now))
    rows, difficulty = _predictions(about, tracks)
    ids = lane_ids(features)
    lights = named_parts(description, "dynamic_map_states", "description")
    signals = read_signals(lights, ids, num_steps, origin_xyz_m)
    try:
        scene = Scene(
            scenario_id=_scenario_id(description),
            origin_xyz_m=origin_xyz_m,
            timestamps_s=timestamps_s,
            now=now,
            ego=ego_row,
            predict_row=rows,
            predict_difficulty=difficulty,
            interest_id=_interest(about, tracks),
            tracks=world.around(origin_xyz_m),
            road_map=read_road_map(features, ids, convention, origin_xyz_m),
            signals=signals,
            lights_recorded=len(signals.step) > 0 or _records_lights(about, convention),
        )
    except SceneError as error:
        raise RecordError(f"not a usable description: {error}") from error
    return ReadScene(scene, dataset, convention.annotation_hz)


def _description(files: SceneFiles) -> Part:
    found = unpickle(read_bytes(files.paths[0]))
    if not isinstance(found, dict):
        raise RecordError(f"holds {type(found).__name__}, not a scene's dictionary")
    if "tracks" not in found or "map_features" not in found:
        raise RecordError("holds no scene: it has no tracks or no map_features")
    return found


def _scenario_id(description: Part) -> str:
    about = description.get("metadata")
    about = about if isinstance(about, dict) else {}
    for name in (about.get("scenario_id"), description.get("id")):
        if text := text_of(name):
            return text[:_MAX_ID_LETTERS]
    raise RecordError("scenario id is missing")


def _timestamps(description: Part, about: Part) -> Float64[np.ndarray, " step"]:
    num_steps = integer_of(description.get("length"), -1)
    if not 0 < num_steps <= MAX_STEPS:
        raise RecordError(f"length is {num_steps}; expected 1 to {MAX_STEPS} steps")
    if about.get("ts") is None:
        return CLOCK.step_s * np.arange(num_steps)
    timestamps_s = array(about["ts"])
    if timestamps_s.shape != (num_steps,):
        raise RecordError(f"{timestamps_s.shape} timestamps for {num_steps} steps")
    if not np.isfinite(timestamps_s).all():
        raise RecordError("a timestamp is not finite")
    step_s = float(np.median(np.diff(timestamps_s))) if num_steps > 1 else CLOCK.step_s
    if abs(step_s - CLOCK.step_s) > STEP_TOLERANCE_S:
        raise RecordError(f"steps are {step_s:g} s apart; expected {CLOCK.step_s:g} s")
    return timestamps_s


def _ego(about: Part, tracks: Mapping[str, Part]) -> str:
    ego = str(about.get("sdc_id"))[:_MAX_ID_LETTERS]
    if ego not in tracks:
        raise RecordError(f"ego (sdc_id {ego[:40]!r}) is not one of the tracks")
    return ego


def _now(about: Part, asked: int | None, num_steps: int) -> int:
    """Return the step that is asked for, else the description's own, else step 10."""
    now = integer_of(about.get("current_time_index"), NOW) if asked is None else asked
    if not 0 <= now < num_steps:
        raise RecordError(f"current step {now} is not one of the {num_steps} steps")
    return now


def _origin(about: Part, near: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    if ORIGIN not in about:
        return near
    found = array(about[ORIGIN])
    if found.shape != (3,) or not (np.abs(found - near) < 1e6).all():
        raise RecordError(f"{ORIGIN} is no place near the ego")
    return found


def _records_lights(about: Part, convention: Convention) -> bool:
    """Whether a scene without lights has none; else its source does not record them."""
    return convention.lights and about.get(LIGHTS_RECORDED) is not False


def _predictions(about: Part, tracks: Mapping[str, Part]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and difficulties of the tracks to predict."""
    wanted = about.get("tracks_to_predict")
    places = {name: row for row, name in enumerate(tracks)}
    rows, levels = [], []
    for name, each in wanted.items() if isinstance(wanted, dict) else ():
        if str(name) not in places:
            raise RecordError(
                f"track to predict {str(name)[:40]!r} is not one of the tracks"
            )
        level = integer_of(each.get("difficulty")) if isinstance(each, dict) else 0
        rows.append(places[str(name)])
        levels.append(level if 0 <= level <= _MAX_DIFFICULTY else 0)
    return np.array(rows, np.int32), np.array(levels, np.int8)


def _interest(about: Part, tracks: Mapping[str, Part]) -> np.ndarray:
    """Ids of the objects of interest."""
    ids: Mapping[str, Any] = track_ids(tracks)
    named = [str(name) for name in sequence_of(about.get("objects_of_interest"))]
    found = [ids.get(name, integer_name(name)) for name in named]
    return np.array([each for each in found if _is_track_id(each)], np.int32)


def _is_track_id(number: int | None) -> bool:
    return number is not None and -(2**31) <= number < 2**31
