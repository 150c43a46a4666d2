from pathlib import Path

import pytest

from pipeline.splits import in_split, shares, split_of
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


@pytest.mark.parametrize(
    ("most", "taken"), [(0, [9, 1, 4]), (14, [9, 1, 4]), (7, [4, 1, 2]), (1, [0, 0, 1])]
)
def test_of_all_files_alike_some_scenes_are_taken(most, taken):
    files = [Done(str(at), "key", Path(), {"scenes": n}) for at, n in enumerate((9, 1, 4))]

    assert shares(files, most) == taken
