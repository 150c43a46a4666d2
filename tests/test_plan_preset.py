"""``infgen plan --preset``: measured on the built-in records, and nothing is made."""

import json
from pathlib import Path

import pytest

from cli import main

pytestmark = pytest.mark.slow

ASKED = (
    *("plan", "--root", "R", "--preset", "paper", "--profile", "tiny"),
    *("--records", "builtin", "--arms", "smart", "--json"),
)


@pytest.fixture
def infgen(tmp_path, monkeypatch, capsys):
    """``infgen("plan", ...)`` in an empty folder: (exit code, output, error output)."""
    monkeypatch.chdir(tmp_path)

    def call(*words):
        code = 0
        try:
            main(list(words))
        except SystemExit as left:
            code = left.code or 0
        return code, *capsys.readouterr()

    return call


def test_a_probe_is_made_once_and_leaves_nothing_but_its_figures(infgen):
    code, out, err = infgen(*ASKED)

    assert code == 0, err
    told = json.loads(out)
    assert {each["stage"] for each in told["stages"]} == {
        *("ingest", "build-vocab", "tokenize", "train", "reference", "rollout", "score"),
        *("score of logs", "validation of training", "checkpoints"),
    }
    within = ("validation of training", "checkpoints")
    for each in told["stages"]:
        assert each["hours"] >= 0 if each["stage"] in within else each["hours"] > 0
        assert (each["files"] == 0) == (each["stage"] in within)
    assert told["probe"]["splits"]["training"]["scenes"] == 24
    assert told["probe"]["seconds"] > 0
    assert [path.suffix for path in Path("R").rglob("*") if path.is_file()] == [".json"]

    again = json.loads(infgen(*ASKED, "--dask", "local:2", "--budget", "1h")[1])
    assert again["probe"]["seconds"] == 0
    assert again["stages"] == told["stages"]
    assert again["hours"] < told["hours"]
    assert again["budget"]["share"] == 1.0


def test_a_budget_without_a_preset_is_refused(infgen):
    code, _, err = infgen("plan", "--root", "R", "--records", "builtin", "--budget", "1h")

    assert code == 2
    assert "--budget 1h is said of a preset" in err
