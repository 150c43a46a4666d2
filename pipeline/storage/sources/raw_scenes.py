"""Raw scenes by id, of TFRecords and of scene files alike, without an ingested store."""

from collections.abc import Iterator
from typing import NamedTuple

from infgen.scene import Scene
from infgen.sources.registry import FoundScene
from infgen.sources.tfrecord import BadRecord, RecordError, iter_records, read_record
from infgen.sources.womd import decode_scene, read_scenario_id
from pipeline.storage.sources.source_files import RawRecords


class RecordPlace(NamedTuple):
    """Where a record lies."""

    url: str
    offset: int


class RawScene(NamedTuple):
    """A scene that is not decoded yet.

    Attributes:
        scenario_id: Its id.
        place: Where it lies, to read it again.
        data: Its record; none of scene files, which are read when they are decoded.
    """

    scenario_id: str
    place: RecordPlace | FoundScene
    data: bytes

    def decode(self) -> Scene:
        """Decode it, reading it again if its record is not there.

        Raises:
            RecordError: if it is no scene that can be used.
        """
        if isinstance(self.place, FoundScene):
            try:
                return self.place.read().scene
            except RecordError as error:
                raise RecordError(f"{self.place.files.name}: {error}") from error
        return decode_scene(self.data or _reread(self.place))


def iter_raw_scenes(records: RawRecords, bad: list[str]) -> Iterator[RawScene]:
    """Stream all records and scene files that can be read so far as to have an id.

    Args:
        records: What some patterns name.
        bad: Why others cannot is added here.
    """
    for url in records.urls:
        for record in iter_records(url):
            try:
                if isinstance(record, BadRecord):
                    raise RecordError(record.reason)
                scenario_id = read_scenario_id(record.data)
            except RecordError as error:
                bad.append(f"{url}, record {record.number}: {error}")
                continue
            yield RawScene(scenario_id, RecordPlace(url, record.offset), record.data)
    for scene in records.scenes:
        yield RawScene(scene.label.scenario_id, scene, b"")


def _reread(place: RecordPlace) -> bytes:
    record = read_record(place.url, place.offset)
    if isinstance(record, BadRecord):
        raise RecordError(f"{place.url} at byte {place.offset}: {record.reason}")
    return record.data
