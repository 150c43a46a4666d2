"""Costs of a stage, from units whose seconds are made by hand."""

import json

import pytest

from pipeline.comparison.costs import (
    cost_of_files,
    cost_of_rollouts,
    cost_of_scores,
    costs_of_training,
    fit_line,
)
from pipeline.comparison.workload import Split
from pipeline.engine.atomic import MANIFEST
from pipeline.workers.measured import MeasuredUnit


@pytest.fixture
def unit(tmp_path):
    """``unit(name, seconds, report, marks, done)``, with one file of 100 bytes."""
    about = {"schema": "infgen.manifest/1", "files": {"a.parquet": [100, "0"]}}
    (tmp_path / MANIFEST).write_text(json.dumps(about))

    def make(name, seconds, report, marks=(), done=()):
        return MeasuredUnit(name, seconds, marks, done, tmp_path, report)

    return make


def test_what_a_unit_takes_is_told_from_what_its_scenes_take(unit):
    made = [
        unit("training.tfrecord-00000-of-00003", 9.0, {"scenes": 2}),  # Loads code.
        unit("training.tfrecord-00001-of-00003", 1.0 + 2 * 0.5, {"scenes": 2}),
        unit("training.tfrecord-00002-of-00003", 1.0 + 12 * 0.5, {"scenes": 12}),
    ]

    found = cost_of_files("ingest", made, {"training": Split(10, 100, 2)})

    assert found.per_unit == pytest.approx(1.0)
    assert found.seconds == pytest.approx(0.5)
    assert found.bytes == pytest.approx(200 / 14)
    assert found.files == 1 + 2


def test_splits_count_as_much_as_they_have_of_all_scenes(unit):
    made = [
        unit(f"{split}.tfrecord-{at:05d}-of-00003", scenes * each, {"scenes": scenes})
        for split, each in (("training", 1.0), ("validation", 3.0))
        for at, scenes in enumerate((2, 2, 12))
    ]
    splits = {"training": Split(3, 300, 2), "validation": Split(1, 100, 1)}

    found = cost_of_files("tokenize", made, splits)

    assert found.seconds == pytest.approx(0.75 * 1.0 + 0.25 * 3.0)
    assert found.per_unit == pytest.approx(0.0, abs=1e-9)


def test_rollouts_are_split_in_units_scenes_and_token_steps(unit):
    def played(scenes):
        # 4 token steps of 0.5 s a scene, after 1 s for its map; 2 s for the unit.
        starts = [2.0 + at * 3.0 + 1.0 for at in range(scenes)]
        marks = [start + 0.5 * (step + 1) for start in starts for step in range(4)]
        return unit("v", 2.0 + scenes * 3.0, {"rollouts": 2 * scenes}, tuple(marks))

    found = cost_of_rollouts([played(1), played(1), played(2)], seconds=2.0)

    assert found.per_unit == pytest.approx(2.0)
    assert found.seconds == pytest.approx(1.0 / 2)
    assert found.per_token == pytest.approx(0.5 / 2)


def test_scores_of_longer_rollouts_take_more(unit):
    def scored(seconds, tokens):
        counts = {"first": 2, "one": 2, "two": 4}
        return [
            unit(name, 1.0 + count * (seconds + 0.1 * tokens), {"rollouts": count})
            for name, count in counts.items()
        ]

    found = cost_of_scores(scored(0.5, 12), scored(0.5, 4), seconds=6.0, short_s=2.0)

    assert found.per_unit == pytest.approx(1.0)
    assert found.seconds == pytest.approx(0.5)
    assert found.per_token == pytest.approx(0.1)


def test_without_shorter_rollouts_scores_count_as_they_are(unit):
    made = [unit("v", 1.0 + count, {"rollouts": count}) for count in (2, 2, 4)]

    found = cost_of_scores(made, (), seconds=8.0, short_s=2.0)

    assert (found.per_unit, found.seconds) == (pytest.approx(1.0), pytest.approx(1.0))
    assert found.per_token == 0.0


def test_training_is_split_in_steps_validation_and_checkpoints(unit):
    # 2 s to begin, 0.5 s a step, 1 s a validated scene, 3 s to save.
    few = unit("weights", 2.5 + 3 + 1, {}, (2.5,), (1.0,))
    many = unit(
        "weights", 2 + 4 * 0.5 + 3 + 8, {}, (2.5, 3.0, 3.5, 4.0), (1.0, 2.0, 3.0, 4.0)
    )

    found = costs_of_training(few, many, batch=4, validated=(1, 8))

    assert found.steps.seconds == pytest.approx(0.5 / 4)
    assert found.steps.per_unit == pytest.approx(2.0)
    assert found.validation.seconds == pytest.approx(1.0)
    assert found.checkpoint.seconds == pytest.approx(3.0)


def test_fast_steps_are_told_by_two_runs(unit):
    few = unit("weights", 1.0 + 1, {}, (1.0,), (1.0,))
    many = unit("weights", 1.6 + 1, {}, (1.6,), (4.0,))

    found = costs_of_training(few, many, batch=1, validated=(1, 1))

    assert found.steps.seconds == pytest.approx(0.2)
    assert found.steps.per_unit == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([(1, 0.5), (3, 2.0)], (0.0, 0.625)),  # A constant below zero is left out.
        ([(4, 2.0)], (0.0, 0.5)),
        ([(0, 2.0)], (0.0, 2.0)),
    ],
)
def test_nothing_costs_less_than_nothing(points, expected):
    assert fit_line(points) == pytest.approx(expected)
