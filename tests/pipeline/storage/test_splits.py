from pathlib import Path

import pytest

from pipeline.engine.plan import PlanError
from pipeline.engine.stage import FinishedUnit
from pipeline.storage.splits import (
    files_of_split,
    group_name,
    in_split,
    source_of,
    split_of,
    spread_evenly,
)


@pytest.mark.parametrize(
    ("name", "split"),
    [
        ("training.tfrecord-00000-of-01000", "training"),
        ("training.tfrecord-00003-of-00022.gz", "training"),
        ("long_20s.tfrecord-00000-of-00001.gz", "long_20s"),
        ("validation.tfrecord", "validation"),
        ("uncompressed_scenario_training_training.tfrecord-00000-of-01000", "training"),
        (
            "uncompressed_scenario_validation_interactive_validation_interactive.tfrecord-1",
            "validation_interactive",
        ),
        ("uncompressed_scenario_training_20s_training_20s.tfrecord-00001", "training_20s"),
    ],
)
def test_the_split_is_in_the_name(name, split):
    assert split_of(name) == split


def test_the_source_is_in_the_name():
    assert source_of(group_name("training", "argoverse2", 3, 16)) == "argoverse2"
    assert source_of("training.tfrecord-00000-of-01000") == "tfrecord"
    assert source_of("validation.tfrecord") == "tfrecord"


def test_a_file_is_of_its_own_split_only():
    name = "training_20s.tfrecord-00000-of-01000"

    assert in_split(name, "training_20s")
    assert not in_split(name, "training")


def test_a_split_of_one_source_and_a_pattern_are_parts_of_all():
    group, record = "validation.argoverse2-00000-of-00004", "validation.tfrecord-0"

    assert in_split(group, "validation")
    assert in_split(group, "validation.argoverse2")
    assert not in_split(record, "validation.argoverse2")
    assert in_split(record, "validation.tfrecord")
    for name in ("training_20s.tfrecord-00000-of-01000", "long_20s.tfrecord"):
        assert in_split(name, "*_20s")
    assert not in_split(record, "*_20s")


ALL = [list(range(9)), [0], [0, 1, 2, 3]]


def ingested(*counts):
    return [
        FinishedUnit(str(at), "key", Path(), {"scenes": n}) for at, n in enumerate(counts)
    ]


@pytest.mark.parametrize(
    ("most", "taken"),
    [
        (0, ALL),
        (14, ALL),
        (99, ALL),
        (7, [[0, 2, 4, 6, 8], [], [0, 2]]),
        (4, [[0, 3, 7], [], [0]]),
        (1, [[0], [], []]),
    ],
)
def test_scenes_are_taken_evenly_from_all_files_and_within_each(most, taken):
    assert spread_evenly(ingested(9, 1, 4), most) == taken


def test_of_towns_of_ten_views_each_one_view_is_taken_of_every_town():
    assert spread_evenly(ingested(20, 20, 20), 6) == [[0, 10]] * 3
    assert spread_evenly([], 6) == []


def test_a_split_without_a_scene_is_refused_with_the_splits_there_are():
    files = [
        FinishedUnit("training.tfrecord-0", "key", Path(), {"scenes": 3}),
        FinishedUnit("validation.tfrecord-0", "key", Path(), {"scenes": 0}),
        FinishedUnit("validation.tfrecord-1", "key", Path(), {"scenes": 2}),
    ]

    found = files_of_split(files, "validation", to="play", setting="rollout.split")

    assert [done.name for done in found] == [done.name for done in files[1:]]
    wrong = r"no file of split 'test' to play \(there is: training, validation\); set"
    with pytest.raises(PlanError, match=wrong):
        files_of_split(files, "test", to="play", setting="rollout.split")
    with pytest.raises(PlanError, match="no record of its 1 files is usable"):
        files_of_split(files[:2], "validation", to="play", setting="rollout.split")
