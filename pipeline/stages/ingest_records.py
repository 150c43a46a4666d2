"""What a unit of stage ``ingest`` reads: the records of a TFRecord, or a group of scenes.

Both come as ``Ingested``, one after the other, so that one scene is in memory at a time.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from infgen.scene import Scene
from infgen.sources.remote_files import file_bytes
from infgen.sources.tfrecord import BadRecord, Record, RecordError, iter_records
from infgen.sources.womd import scene_or_bad_record
from pipeline.storage.sources.scene_groups import scene_of

WOMD = "womd"
ANNOTATION_HZ = 10.0


@dataclass(frozen=True, slots=True)
class Ingested:
    """One record or scene file, read.

    Attributes:
        number: Position in the TFRecord or group, counted from 0.
        offset: Of the first byte in the TFRecord; 0 in a group.
        file: Name of the TFRecord, or of the scene's folder or file.
        num_bytes: Of the record or files; 0 where they could not be read.
        found: The scene, or why there is none.
        dataset: Where it comes from: ``womd``, or as its source says.
        annotation_hz: Rate at which boxes were placed; below 10 steps are interpolated.
    """

    number: int
    offset: int
    file: str
    num_bytes: int
    found: Scene | str
    dataset: str = WOMD
    annotation_hz: float = ANNOTATION_HZ


def iter_ingested(name: str, task: Mapping[str, Any], now_step: int) -> Iterator[Ingested]:
    """Read what a unit's task names, in order.

    Args:
        name: Of the unit.
        task: A ``url``, or ``scenes``: parts of a group.
        now_step: Last step of the history in scene files; 0 for their own.

    Raises:
        OSError: if a file cannot be read.
    """
    if "scenes" not in task:
        yield from _from_tfrecord(name, task["url"])
        return
    for number, part in enumerate(task["scenes"]):
        yield _from_files(number, part, now_step)


def _from_tfrecord(name: str, url: str) -> Iterator[Ingested]:
    for record in iter_records(url):
        size = len(record.data) if isinstance(record, Record) else 0
        found = scene_or_bad_record(record) if isinstance(record, Record) else record
        usable = found.reason if isinstance(found, BadRecord) else found
        yield Ingested(record.number, record.offset, name, size, usable)


def _from_files(number: int, part: Mapping[str, Any], now_step: int) -> Ingested:
    scene = scene_of(part)
    size = sum(map(file_bytes, scene.files.paths))
    try:
        read = scene.read(now_step or None)
    except RecordError as error:
        return Ingested(number, 0, scene.files.name, size, str(error), scene.source)
    return Ingested(
        number, 0, scene.files.name, size, read.scene, read.dataset, read.annotation_hz
    )
