"""The few records of a probe are like all of which they are taken."""

import numpy as np
import pytest

from infgen.sources.tfrecord import Record, frame, iter_records
from infgen.sources.towns import builtin_records
from infgen.sources.womd import count_tracks, decode_scene
from pipeline.comparison.sample import (
    RecordSize,
    arrange,
    choose,
    read_sizes,
    write_sample,
)
from pipeline.comparison.workload import Split
from pipeline.storage.sources.source_files import RawRecords

PLAYED = 4
BUILTIN = [str(path) for path in builtin_records()]


def mean_tracks(records):
    return np.mean([one.tracks for one in records])


@pytest.fixture
def neighbours_alike():
    """400 records of which a few large ones follow each other, as views of one town do."""
    tracks = [*[200] * 40, *[20] * 200, *range(10, 170)]
    return [RecordSize("a", at, each, 9000 * each) for at, each in enumerate(tracks)]


def test_chosen_records_have_as_many_tracks_as_all_have(neighbours_alike):
    chosen = choose(neighbours_alike, 16)

    assert len(set(chosen)) == 16
    assert mean_tracks(chosen) == pytest.approx(mean_tracks(neighbours_alike), rel=0.03)
    assert mean_tracks(neighbours_alike[:16]) > 2 * mean_tracks(neighbours_alike)


def test_small_and_large_files_are_like_all(neighbours_alike):
    chosen = choose(neighbours_alike, 16)

    files = arrange(chosen, PLAYED)

    assert [len(file) for file in files] == [1, 1, 1, 13]
    assert sorted(one.number for file in files for one in file) == sorted(
        one.number for one in chosen
    )
    for measured in (files[1] + files[2], files[3]):
        assert mean_tracks(measured) == pytest.approx(mean_tracks(chosen), rel=0.1)
    # Rows 0, 4, 8 and 12 of all are simulated; the first of them is not counted.
    simulated = [one for file in files for one in file][4::4]
    assert mean_tracks(simulated) == pytest.approx(mean_tracks(chosen), rel=0.1)


@pytest.mark.parametrize(
    ("count", "expected"), [(0, []), (1, [1]), (3, [1, 1, 1]), (5, [1, 1, 1, 2])]
)
def test_few_records_are_all_taken(neighbours_alike, count, expected):
    files = arrange(choose(neighbours_alike[:count], 16), PLAYED)

    assert [len(file) for file in files] == expected


def test_records_are_counted_in_files_of_each_split():
    found = read_sizes(RawRecords(BUILTIN, []))

    assert {name: each.split for name, each in found.items()} == {
        "training": Split(2, 24, 2),
        "validation": Split(1, 8, 1),
    }
    assert [len(each.sizes) for each in found.values()] == [24, 8]


def test_small_files_are_counted_until_there_are_enough(tmp_path):
    record = next(each for each in iter_records(BUILTIN[0]) if isinstance(each, Record))
    small = [tmp_path / f"training.tfrecord-{at:05d}-of-00020" for at in range(20)]
    for path in small:
        path.write_bytes(frame(record.data) * 3)

    found = read_sizes(RawRecords([str(path) for path in small], []))["training"]

    assert found.split == Split(20, 60, 8)


def test_what_is_not_usable_is_counted_but_not_taken(tmp_path):
    record = next(each for each in iter_records(BUILTIN[0]) if isinstance(each, Record))
    path = tmp_path / "training.tfrecord-00000-of-00001"
    path.write_bytes(
        frame(b"\xff" * 20) + frame(b"") + frame(b"x" * 8) + frame(record.data)
    )

    found = read_sizes(RawRecords([str(path)], []))["training"]

    assert found.split.scenes == 4
    assert [one.number for one in found.sizes] == [3]


def test_tracks_are_counted_without_decoding():
    for record in iter_records(BUILTIN[0]):
        assert isinstance(record, Record)
        assert count_tracks(record.data) == len(decode_scene(record.data).tracks.id)


def test_a_sample_holds_the_chosen_records_as_they_are(tmp_path):
    sizes = read_sizes(RawRecords(BUILTIN, []))

    write_sample(sizes, tmp_path / "sample", PLAYED)

    written = sorted((tmp_path / "sample").iterdir())
    records = {path.name: [each.data for each in iter_records(path)] for path in written}
    assert {name: len(data) for name, data in records.items()} == {
        **{f"training.tfrecord-{at:05d}-of-00004": 1 for at in range(3)},
        "training.tfrecord-00003-of-00004": 13,
        **{f"validation.tfrecord-{at:05d}-of-00004": 1 for at in range(3)},
        "validation.tfrecord-00003-of-00004": 5,
    }
    known = {each.data for url in BUILTIN for each in iter_records(url)}
    taken = [data for each in records.values() for data in each]
    assert len(set(taken)) == len(taken) == 24
    assert set(taken) <= known
