from pathlib import Path

import pytest

from pipeline.splits import in_split, split_of, spread
from pipeline.stage import Done


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


def test_a_file_is_of_its_own_split_only():
    name = "training_20s.tfrecord-00000-of-01000"

    assert in_split(name, "training_20s")
    assert not in_split(name, "training")


ALL = [list(range(9)), [0], [0, 1, 2, 3]]


def files_of(*counts):
    return [Done(str(at), "key", Path(), {"scenes": n}) for at, n in enumerate(counts)]


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
    assert spread(files_of(9, 1, 4), most) == taken


def test_of_towns_of_ten_views_each_one_view_is_taken_of_every_town():
    assert spread(files_of(20, 20, 20), 6) == [[0, 10]] * 3
    assert spread([], 6) == []
