"""Which records a probe reads: few, that together are like all.

What a scene takes goes with its agents, and scenes differ tenfold in these: the mean of
sixteen neighbours may be half that of all. So the records of some files are counted with
their tracks, sorted by them and cut into as many parts as records are wanted; of each part
the one nearest to its mean is taken.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

from infgen.sources.tfrecord import BadRecord, Record, RecordError, frame, iter_records
from infgen.sources.womd import count_tracks
from pipeline.comparison.workload import Split
from pipeline.engine.plan import PlanError
from pipeline.storage.sources.source_files import RawRecords
from pipeline.storage.splits import split_of

RECORDS = 16
"""That are read, of each split."""
SINGLES = 2
"""Files of one record each, besides a last one that gets all others: units of two sizes
tell what a unit takes from what a scene does. One more is before them: the first unit loads
code, and is not counted."""
COUNTED_FILES, MORE_FILES, ENOUGH_RECORDS = 2, 8, 400
"""Files of each split whose records are counted, and more of them where there are fewer
than so many records."""


@dataclass(frozen=True, slots=True)
class RecordSize:
    """One usable record.

    Attributes:
        url: Its file.
        number: Its position in that.
        tracks: How many it has.
        bytes: Its length.
    """

    url: str
    number: int
    tracks: int
    bytes: int


@dataclass(frozen=True, slots=True)
class SplitSizes:
    """The records of a split, as far as they are counted.

    Attributes:
        split: How many there are.
        sizes: Of the usable ones.
    """

    split: Split
    sizes: Sequence[RecordSize]


def read_sizes(records: RawRecords) -> dict[str, SplitSizes]:
    """Count the records of a few files of each split.

    Raises:
        PlanError: if there are scene files, whose work cannot be estimated.
    """
    if records.scenes:
        raise PlanError(
            f"{records.scenes[0].files.name} is no TFRecord; estimates are made of "
            "TFRecords only (`infgen plan` without --preset says what would be made)"
        )
    files: dict[str, list[str]] = {}
    for url in records.urls:
        files.setdefault(split_of(url.rsplit("/", 1)[-1]), []).append(url)
    return {split: _count(urls) for split, urls in files.items()}


def _count(urls: Sequence[str]) -> SplitSizes:
    """Count some files, the others count as much as their mean."""
    counted = total = 0
    sizes: list[RecordSize] = []
    for url in _spread(urls, MORE_FILES):
        if counted >= COUNTED_FILES and total >= ENOUGH_RECORDS:
            break
        counted += 1
        for record in iter_records(url):
            total += 1
            sizes += _size(url, record)
    split = Split(len(urls), round(total * len(urls) / counted), counted)
    return SplitSizes(split, sizes)


def _spread(urls: Sequence[str], most: int) -> list[str]:
    """Choose files evenly: the first ``COUNTED_FILES`` too are spread over all."""
    count = min(most, len(urls))
    chosen = [urls[at * len(urls) // count] for at in range(count)]
    apart = -(-count // COUNTED_FILES)
    return [url for first in range(apart) for url in chosen[first::apart]]


def _size(url: str, record: Record | BadRecord) -> list[RecordSize]:
    """Return the size of a record; none of one that is not usable."""
    if isinstance(record, BadRecord):
        return []
    try:
        tracks = count_tracks(record.data)
    except RecordError:
        return []
    return [RecordSize(url, record.number, tracks, len(record.data))] if tracks else []


def choose(sizes: Sequence[RecordSize], count: int = RECORDS) -> list[RecordSize]:
    """Choose records that together are like all: one of each part of them, by size.

    Args:
        sizes: Of all records.
        count: How many to choose; all, if there are not so many.
    """
    ranked = sorted(sizes, key=lambda one: (one.tracks, one.bytes))
    count = min(count, len(ranked))
    ends = [len(ranked) * at // count for at in range(count + 1)] if count else [0]
    parts = [ranked[first:after] for first, after in pairwise(ends)]
    return [_most_like(part, 1)[0] for part in parts]


def arrange(chosen: Sequence[RecordSize], played: int) -> list[list[RecordSize]]:
    """Put records in files: of one record each, together like all of them, and a large one.

    Args:
        chosen: The records.
        played: How many scenes of them are simulated, evenly spread over all.
    """
    if not chosen:
        return []
    left = list(chosen)
    singles = _take(left, chosen, min(SINGLES, len(left) - 1))
    first = _take(left, chosen, min(1, len(left) - 1))
    # Few scenes are simulated, and those of the last file are like all too.
    before = len(chosen) - len(left)
    rows = {at * len(chosen) // played - before for at in range(played)}
    typical = sorted(row for row in rows if 0 <= row < len(left))
    last = dict(zip(typical, _take(left, chosen, len(typical)), strict=True))
    others = iter(left)
    rest = [last.get(row) or next(others) for row in range(len(last) + len(left))]
    return [*([one] for one in first + singles), rest]


def _take(
    left: list[RecordSize], like: Sequence[RecordSize], count: int
) -> list[RecordSize]:
    """Take out so many that are like all."""
    if not count:
        return []
    taken = _most_like(left, count, like)
    for one in taken:
        left.remove(one)
    return taken


def _most_like(
    among: Sequence[RecordSize], count: int, like: Sequence[RecordSize] = ()
) -> list[RecordSize]:
    """Find so many whose mean sizes are nearest to those of all (``among``, if empty).

    Tracks count twice: as they are, and squared, since some work grows faster than they do.
    """
    features = _features(among)
    wanted = _features(like or among).mean(axis=0)

    def distance(rows: tuple[int, ...]) -> float:
        off = features[list(rows)].mean(axis=0) / wanted - 1
        return float(np.abs(off).sum())

    best = min(combinations(range(len(among)), count), key=distance)
    return [among[row] for row in best]


def _features(sizes: Sequence[RecordSize]) -> np.ndarray:
    tracks = np.array([one.tracks for one in sizes], float)
    length = np.array([one.bytes for one in sizes], float)
    return np.column_stack([tracks, tracks**2, length])


def write_sample(sizes: Mapping[str, SplitSizes], folder: Path, played: int) -> None:
    """Write a sample of each split, as files of two sizes.

    Args:
        sizes: Of the records of each split.
        folder: Where; it is made.
        played: How many scenes are simulated, of one split.
    """
    folder.mkdir()
    for split, each in sizes.items():
        files = arrange(choose(each.sizes), played)
        data = dict(_read([one for file in files for one in file]))
        for at, file in enumerate(files):
            name = f"{split}.tfrecord-{at:05d}-of-{len(files):05d}"
            (folder / name).write_bytes(b"".join(frame(data[one]) for one in file))


def _read(chosen: Sequence[RecordSize]) -> Iterator[tuple[RecordSize, bytes]]:
    """Read some records again, a file at a time."""
    by_file: dict[str, dict[int, RecordSize]] = {}
    for one in chosen:
        by_file.setdefault(one.url, {})[one.number] = one
    for url, wanted in by_file.items():
        for record in iter_records(url):
            if isinstance(record, Record) and record.number in wanted:
                yield wanted[record.number], record.data
