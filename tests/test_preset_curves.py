"""Presets ``scaling`` and ``transfer``, with the smallest networks there can be."""

import csv
import json
import shutil

import pytest

from cli import main
from infgen.sources.towns import builtin_records

pytestmark = pytest.mark.slow

TINY = (
    *("--profile", "tiny", "--seeds", "1", "--root", "R", "--json"),
    *("-s", "train.steps=1", "-s", "train.batch_scenes=1"),
    *("-s", "train.validation_scenes=1", "-s", "ingest.max_scenes_per_file=1"),
    *("-s", "train.checkpoint_every_steps=0", "-s", "score.bootstrap_resamples=20"),
)


def run_preset(name, *more):
    with pytest.raises(SystemExit) as left:
        main(["run", "report", "--preset", name, *TINY, *more])
    assert not left.value.code


def rows_of(folder):
    with (folder / "tables/learning-curve.csv").open() as file:
        return list(csv.reader(file))


def test_points_of_a_scaling_curve_go_on_from_each_other(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    arms = "shown-1k,shown-2k,shown-4k"

    run_preset("scaling", "--records", "builtin", "--arms", arms, "-s", "rollout.seconds=4")

    shown = tmp_path / "R/presets/scaling"
    header, *rows = rows_of(shown)
    # Each was trained for one step, on top of those before it.
    assert header[:2] == ["line", "scenes shown in training"]
    assert [[row[0], float(row[1])] for row in rows] == [["InfGen", at] for at in (1, 2, 3)]
    told = json.loads((shown / "comparison.json").read_text())
    assert len({run["keys"]["train"] for run in told["runs"]}) == 3
    assert len({run["weights"] for run in told["runs"]}) == 3
    with (shown / "tables/learning-curve-scores.csv").open() as file:
        scores = {row["score"] for row in csv.DictReader(file)}
    numbers = told["arms"]["shown-1k"]["long"]
    assert scores == {
        name.removeprefix("proper/") for name in numbers if name.startswith("proper/")
    }


def test_transfer_reads_towns_and_real_records(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # The package's records stand for both: one file for towns, the others for real ones.
    towns, training, validation = builtin_records()
    shutil.copyfile(towns, tmp_path / "towns.tfrecord-00000-of-00001.gz")
    shutil.copyfile(training, tmp_path / "training.tfrecord-00000-of-00001.gz")
    shutil.copyfile(validation, tmp_path / "validation.tfrecord-00000-of-00001.gz")
    arms = "real-50,towns-real-50,real-50-towns"

    run_preset("transfer", "--records", str(tmp_path / "*.gz"), "--arms", arms)

    header, *rows = rows_of(tmp_path / "R/presets/transfer")
    assert header[1] == "real scenes learned from"
    assert sorted(row[0] for row in rows) == [
        "real alone",
        "real, then towns",
        "towns, then real",
    ]
    assert {float(row[1]) for row in rows} == {50.0}
