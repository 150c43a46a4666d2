"""Waymo Open Motion Dataset: ``Scenario`` records -> ``Scene``. Waymo's names end here.

``iter_scenes("training.tfrecord-00000-of-01000")`` is the way in; field numbers are facts
of the public format.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from infgen.scene import Scene, SceneError
from infgen.sources import wire
from infgen.sources.batch import Messages, decode
from infgen.sources.tfrecord import BadRecord, Record, RecordError, iter_records
from infgen.sources.wire import BYTES, VARINT, Field, WireError, tag
from infgen.sources.womd_roads import read_road_map
from infgen.sources.womd_signals import read_signals
from infgen.sources.womd_tracks import origin_near, read_tracks

_TIMESTAMPS, _TRACKS, _INTEREST, _ID, _EGO = 1, 2, 4, 5, 6
_DYNAMIC, _FEATURES, _NOW, _PREDICT = 7, 8, 10, 11
_LIDAR, _CAMERA = 12, 13
_TABLE = tag(1, BYTES)
_PREDICTION = {"row": tag(1, VARINT), "difficulty": tag(2, VARINT)}
_MAX_DIFFICULTY = 2
MAX_STEPS = 32767
"""Steps of one record: what ``Signals.step`` can count."""


def iter_scenes(url: str | Path) -> Iterator[Scene | BadRecord]:
    """Read the scenes of one TFRecord, plain or GZIP, local or any fsspec URL.

    Raises:
        OSError: if the file cannot be opened or read.
    """
    for record in iter_records(url):
        yield record if isinstance(record, BadRecord) else scene_or_bad_record(record)


def scene_or_bad_record(record: Record) -> Scene | BadRecord:
    """Decode one record; one that is no usable scene comes back with the reason."""
    try:
        return decode_scene(record.data)
    except RecordError as error:
        return BadRecord(record.number, record.offset, str(error))


def decode_scene(data: bytes) -> Scene:
    """Decode one ``Scenario`` record.

    Raises:
        RecordError: if it is no sound message, or no scene that can be used.
    """
    try:
        return _decode_scene(data)
    except (WireError, SceneError) as error:
        raise RecordError(f"not a usable Scenario message: {error}") from error


def read_scenario_id(data: bytes) -> str:
    """Read only the id of a ``Scenario`` record.

    Raises:
        RecordError: if it is no sound message, or has no id.
    """
    try:
        return _scenario_id(data, _by_number(data))
    except WireError as error:
        raise RecordError(f"not a usable Scenario message: {error}") from error


def count_tracks(data: bytes) -> int:
    """Count the tracks of a ``Scenario`` record, without decoding them.

    Raises:
        RecordError: if it is no sound message.
    """
    try:
        return len(_by_number(data)[_TRACKS])
    except WireError as error:
        raise RecordError(f"not a usable Scenario message: {error}") from error


def _decode_scene(data: bytes) -> Scene:
    fields = _by_number(data)
    if not fields[_TRACKS]:
        raise RecordError(_not_a_scenario(data, fields))
    scenario_id = _scenario_id(data, fields)
    timestamps_s = _timestamps(data, fields)
    num_steps = len(timestamps_s)
    now, ego = _roles(fields, num_steps)
    world = read_tracks(data, fields[_TRACKS], num_steps)
    origin_xyz_m = origin_near(world, ego, now)
    rows, difficulty = _predictions(data, fields[_PREDICT], len(world.id))
    interest = wire.varints(data, fields[_INTEREST], _INTEREST)
    return Scene(
        scenario_id=scenario_id,
        origin_xyz_m=origin_xyz_m,
        timestamps_s=timestamps_s,
        now=now,
        ego=ego,
        predict_row=rows,
        predict_difficulty=difficulty,
        interest_id=np.array(interest, np.int64).astype(np.int32),
        tracks=world.around(origin_xyz_m),
        road_map=read_road_map(data, fields[_FEATURES], origin_xyz_m),
        signals=read_signals(data, fields[_DYNAMIC], num_steps, origin_xyz_m),
    )


def _by_number(data: bytes) -> Mapping[int, list[Field]]:
    if not data:
        raise RecordError("record is empty")
    fields: dict[int, list[Field]] = defaultdict(list)
    for field in wire.walk(data, 0, len(data)):
        fields[field.tag >> 3].append(field)
    return fields


def _scenario_id(data: bytes, fields: Mapping[int, list[Field]]) -> str:
    found = [field for field in fields[_ID] if field.tag == tag(_ID, BYTES)]
    raw = data[found[-1].start : found[-1].end] if found else b""
    if not raw:
        raise RecordError("scenario id is empty")
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        raise RecordError(f"scenario id {raw[:40]!r} is not UTF-8") from error


def _timestamps(
    data: bytes, fields: Mapping[int, list[Field]]
) -> Float64[np.ndarray, " step"]:
    found = wire.doubles(data, fields[_TIMESTAMPS], _TIMESTAMPS)
    if not 0 < len(found) <= MAX_STEPS:
        raise RecordError(f"record has {len(found)} timestamps; expected 1 to {MAX_STEPS}")
    timestamps_s = np.array(found, np.float64)
    if not np.isfinite(timestamps_s).all():
        raise RecordError("a timestamp is not finite")
    return timestamps_s


def _roles(fields: Mapping[int, list[Field]], num_steps: int) -> tuple[int, int]:
    """Return the current step and the row of the ego."""
    now = wire.signed(wire.last(fields[_NOW], tag(_NOW, VARINT)), 32)
    if not 0 <= now < num_steps:
        raise RecordError(f"current step {now} is not one of the {num_steps} steps")
    if not any(field.tag == tag(_EGO, VARINT) for field in fields[_EGO]):
        raise RecordError("record has no ego: sdc_track_index is missing")
    ego = wire.signed(wire.last(fields[_EGO], tag(_EGO, VARINT)), 32)
    if not 0 <= ego < len(fields[_TRACKS]):
        raise RecordError(f"ego row {ego} is not one of the {len(fields[_TRACKS])} tracks")
    return now, ego


def _predictions(
    data: bytes, fields: Sequence[Field], num_agents: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and difficulties of the tracks to predict."""
    starts = np.array([field.start for field in fields], np.int64)
    ends = np.array([field.end for field in fields], np.int64)
    table = decode(data, Messages(starts, ends - starts), _PREDICTION)
    rows = table["row"].astype(np.int64).astype(np.int32)
    outside = (rows < 0) | (rows >= num_agents)
    if outside.any():
        row = rows[np.argmax(outside)]
        raise RecordError(f"track to predict {row} is not one of the {num_agents} tracks")
    levels = table["difficulty"]
    return rows, np.where(levels > _MAX_DIFFICULTY, 0, levels).astype(np.int8)


def _not_a_scenario(data: bytes, fields: Mapping[int, list[Field]]) -> str:
    """Say what a record without tracks is."""
    numbers = {number for number, found in fields.items() if found}
    if numbers == {1} and all(_is_features(data, field) for field in fields[1]):
        return "record holds a tf.Example, not a Scenario: use WOMD's scenario files"
    if fields[_LIDAR] or fields[_CAMERA]:
        return "record holds only lidar or camera data, no tracks"
    return "record has no tracks"


def _is_features(data: bytes, field: Field) -> bool:
    """Tell whether a field is the table of named features of a tf.Example."""
    try:
        entries = wire.walk(data, field.start, field.end)
        keys = [wire.walk(data, entry.start, entry.end)[:1] for entry in entries]
    except WireError:
        return False
    return field.tag == _TABLE and all(key and key[0].tag == _TABLE for key in keys)
