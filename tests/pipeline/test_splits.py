import pytest

from pipeline.splits import in_split, split_of


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
