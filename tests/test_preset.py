"""A whole comparison, from records to tables, of the smallest networks there can be."""

import csv
import json
import os
import re
import shutil
from pathlib import Path

import pytest

from cli import main
from pipeline.settings.stages_file import DEFAULT_FILE

pytestmark = pytest.mark.slow

PRESETS = """
  pair:
    profile: small,benchmark,tiny
    seeds: 2
    rollout_sets:
      long: {}
      motion-only: {rollout: {mode: motion-only}}
      wosac: {rollout: {mode: wosac}}
    arms:
      infgen: {published: InfGen, rollout_sets: [long, motion-only, wosac]}
      smart:
        published: SMART-7M
        profile: smart
        rollout_sets: {long: {score: {presence_radius_m: 75}}}
      infgen-safe: {rules_of: infgen, rollout: {rules: safe}}

  odd:
    profile: small,benchmark,tiny
    rollout_sets: {long: {}}
    arms:
      infgen: {published: InfGen, rollout_sets: [long]}
      odd: {label: Odd one, train: {motion_weight: 1e38}, rollout_sets: [long]}
      odder: {profile: smart, starts_from: odd, rollout_sets: [long]}
  wrong:
    profile: small,benchmark,tiny
    rollout_sets: {long: {}}
    arms:
      infgen: {published: InfGen, rollout_sets: [long]}
      wrong: {model: {width: 15}, rollout_sets: [long]}
"""
"""Beside those of the package: one that goes well, one that does not, one that cannot."""
RUNS = 2 * (3 + 1)
SETTINGS = (
    *(
        "-s",
        "train.steps=1",
        "-s",
        "train.batch_scenes=1",
        "-s",
        "train.checkpoint_every_steps=0",
    ),
    *("-s", "train.validation_scenes=1", "-s", "ingest.max_scenes_per_file=1"),
    *("-s", "score.bootstrap_resamples=20", "--root", "R"),
)
FROM = ("--records", "builtin", "--file", "presets.yaml")
PAIR = ("run", "report", "--preset", "pair", *SETTINGS)
MADE = re.compile(r'"state": "(\w+)"')


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder in which the comparison was made, and the exit code of that."""
    folder = tmp_path_factory.mktemp("desk")
    before = Path.cwd()
    os.chdir(folder)
    text = DEFAULT_FILE.read_text().rstrip() + "\n" + PRESETS
    (folder / "presets.yaml").write_text(text)
    yield folder, call(*PAIR, *FROM, "--json")
    os.chdir(before)


@pytest.fixture
def desk(made, tmp_path, monkeypatch):
    """A copy of that folder, to work in: what a test makes there no other test sees."""
    folder, code = made
    shutil.copytree(folder, tmp_path, symlinks=True, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path, code


def call(*words):
    """Exit code of a command."""
    with pytest.raises(SystemExit) as left:
        main(list(words))
    return left.value.code or 0


@pytest.fixture(scope="module")
def told(made):
    return json.loads((made[0] / "R/presets/pair/comparison.json").read_text())


def test_it_leaves_tables_in_three_forms_every_number_and_one_page(desk):
    folder, code = desk
    shown = folder / "R/presets/pair"

    assert code == 0
    names = {path.name for path in shown.iterdir()}
    files = {"comparison.html", "comparison.json", "tables.json", "figures.pdf"}
    assert {*files, "tables"} <= names
    tables = {path.stem for path in (shown / "tables").iterdir()}
    assert tables == {
        "claims",
        "table-1-short-term",
        "table-2-long-term",
        "table-3-motion-only",
        "proper",
        "against-the-logs",
        "runs",
        "curves",
    }
    for name in tables - {"curves"}:
        for suffix in ("md", "tex", "csv"):
            assert (shown / "tables" / f"{name}.{suffix}").stat().st_size > 0


def test_every_number_can_be_traced(desk, told):
    store = desk[0] / "R/store"

    assert len(told["runs"]) == RUNS
    assert told["missing"] == []
    assert len(told["records"]) == 3
    for run in told["runs"]:
        score = json.loads(
            (store / "score" / run["keys"]["score"][:16])
            .joinpath("summary.json")
            .read_text()
        )
        ace = score["numbers"]["ace/own_near"]["mean"]
        assert run["numbers"]["ace/own_near"]["mean"] == ace
        model = store / "train" / run["keys"]["train"][:16] / "model.json"
        assert json.loads(model.read_text())["weights"] == run["weights"]


def test_what_arms_have_in_common_was_made_once(desk):
    store = desk[0] / "R/store"

    def count(stage):
        return len(list((store / stage).glob("*/manifest.json")))

    shared = ("ingest", "build-vocab", "tokenize", "reference", "comparison")
    assert [count(stage) for stage in shared] == [1, 1, 1, 1, 1]
    assert (count("train"), count("rollout"), count("score")) == (4, RUNS, RUNS)


def test_the_mean_over_seeds_is_that_of_the_runs(told):
    means = [
        run["numbers"]["agents/near"]["mean"]
        for run in told["runs"]
        if (run["arm"], run["rollout_set"]) == ("smart", "long")
    ]

    combined = told["arms"]["smart"]["long"]["agents/near"]
    assert combined["mean"] == pytest.approx(sum(means) / 2)
    assert "2 seeds" in told["interval"]


def test_the_page_stands_alone(desk):
    page = (desk[0] / "R/presets/pair/comparison.html").read_text()

    assert not re.findall(r"@import|url\((?!#)|<script|https?://(?!www\.w3)", page)
    assert page.count("<svg") == page.count("</svg>") > 5
    pdf = (desk[0] / "R/presets/pair/figures.pdf").read_bytes()
    assert pdf.count(b"/MediaBox") == page.count("<svg")
    assert "nan" not in re.findall(r'd="([^"]*)"', page)
    assert "InfGen / SMART" in page


def test_a_second_call_makes_nothing_and_a_root_is_sound_and_has_no_garbage(desk, capsys):
    root = desk[0] / "R"
    before = {path: path.stat().st_mtime_ns for path in root.rglob("manifest.json")}
    capsys.readouterr()

    assert call(*PAIR, "--json") == 0
    assert set(MADE.findall(capsys.readouterr().out)) == {"cached"}
    after = {path: path.stat().st_mtime_ns for path in root.rglob("manifest.json")}
    assert after == before
    assert call("verify", "--root", "R", "--full") == 0
    capsys.readouterr()
    assert call("gc", "--root", "R", "--json") == 0
    assert json.loads(capsys.readouterr().out)["garbage"] == []


def test_a_dry_run_says_what_is_left_to_make(desk, capsys):
    capsys.readouterr()

    assert call(*PAIR, "-n", "--json") == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert [run["makes"] for run in runs] == [[]] * RUNS
    assert call(*PAIR, "-n", "-s", "score.seed=1") == 0
    out = capsys.readouterr().out
    assert out.count("score") == RUNS
    assert "train" not in out


def test_a_dry_run_plans_policy_gradient_from_the_weights_of_the_package(desk, capsys):
    arms = ("--arms", "infgen,catk", "--seeds", "1")
    capsys.readouterr()

    preset = ("--preset", "womd-mini-fine-tuned", *arms)
    code = call("run", "report", *preset, *FROM, "-n", "--json")

    assert code == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    notes = {run["run"].split(",")[0]: run["note"] for run in runs}
    assert notes == {
        "infgen": "after closed-loop",
        "closed-loop": "after insertion-and-removal",
        "insertion-and-removal": "",
        "catk": "after smart",
        "smart": "",
    }


def test_a_failing_arm_is_named_beside_those_that_are_there_and_the_exit_code_is_1(
    desk, capsys
):
    capsys.readouterr()

    code = call("run", "report", "--preset", "odd", *SETTINGS, *FROM)

    assert code == 1
    error = capsys.readouterr().err
    assert re.search(r"odd, seed 0, long: train: weights: .*not finite", error)
    shown = desk[0] / "R/presets/odd"
    told = json.loads((shown / "comparison.json").read_text())
    assert list(told["arms"]) == ["infgen"]
    assert told["missing"][1] == "odder, seed 0, long: there are no weights of odd"
    page = (shown / "comparison.html").read_text()
    assert "odder, seed 0, long: there are no weights of odd" in page
    assert (shown / "tables/table-2-long-term.csv").is_file()


def test_an_arm_that_cannot_be_is_refused_before_any_other_is_begun(desk, capsys):
    capsys.readouterr()

    assert call("run", "report", "--preset", "wrong", *SETTINGS, *FROM) == 2
    error = capsys.readouterr().err
    assert "model: width is 15; expected a multiple of heads (2)" in error
    assert "run 1 of" not in error


def test_fewer_arms_and_seeds_are_fewer_rows(desk, capsys):
    capsys.readouterr()

    assert call(*PAIR, "--arms", "smart", "--seeds", "1") == 0
    out = capsys.readouterr().out
    assert "smart, seed 0, long" in out
    assert "comparison.html" in out
    table = (desk[0] / "R/presets/pair/tables/runs.csv").read_text()
    assert len(table.splitlines()) == 1 + 1


def test_what_rules_change_is_a_table_of_its_own_if_it_is_asked_for(desk, capsys):
    store = desk[0] / "R/store"
    trained = len(list((store / "train").glob("*/manifest.json")))
    capsys.readouterr()

    assert call(*PAIR, "--arms", "infgen,infgen-safe", "--seeds", "1") == 0

    shown = desk[0] / "R/presets/pair"
    assert len(list((store / "train").glob("*/manifest.json"))) == trained
    with (shown / "tables/rules.csv").open() as file:
        logs, off, on = csv.DictReader(file)
    assert (logs["method"], logs["rules"]) == ("the logs of these scenes", "")
    assert (off["method"], off["rules"]) == ("InfGen", "none")
    assert (on["method"], on["rules"]) == ("InfGen", "safe")
    runs = json.loads((shown / "comparison.json").read_text())["runs"]
    rules = {(run["arm"], run["rules"], run["biased"]) for run in runs}
    assert rules == {("infgen", "none", False), ("infgen-safe", "safe", False)}
    page = (shown / "comparison.html").read_text()
    assert "no rules (rollout.rules=none), no biases" in page


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--preset", "womd-mni"], "no preset 'womd-mni'; did you mean 'womd-mini'"),
        (["--preset", "womd-mini", "--arms", "smrt"], "did you mean 'smart'"),
        (["--preset", "womd-mini", "-s", "train.stps=1"], "did you mean 'steps'"),
        (["--preset", "womd-mini"], "reads records of your own"),
    ],
)
def test_wrong_words_are_one_line_and_exit_code_2(
    tmp_path, monkeypatch, capsys, words, message
):
    monkeypatch.chdir(tmp_path)

    assert call("run", "report", "--root", "other", *words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
