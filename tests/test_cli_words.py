"""What the command line says of itself, and of words that cannot be meant."""

import json
import re
from dataclasses import fields
from pathlib import Path

import pytest

from infgen import __version__
from pipeline.engine.registry import MODULES, load_stage
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages
from tests.test_cli import RUN, VERBS, infgen, toys  # noqa: F401

OF_A_ROOT = (("gc", "--yes"), ("verify",), ("show", "total"), ("diff", "total", "count"))
NAMING_A_ROOT = (
    *OF_A_ROOT,
    ("run",),
    ("score",),
    ("status",),
    ("status", "--watch", "--check"),
    ("plan",),
    ("doctor",),
    ("demo",),
    ("view",),
    ("export", "--to", "parquet", "--out", "x"),
    ("run", "--preset", "towns-benchmark"),
)


def named(words):
    return " ".join(words)


@pytest.mark.parametrize("words", OF_A_ROOT, ids=named)
def test_a_root_that_is_not_there_is_no_root_without_damage(infgen, words):  # noqa: F811
    Path("empty").mkdir()

    code, out, err = infgen(*words, "--root", "typo")
    assert (code, out) == (2, "")
    assert err.startswith("infgen: typo: no such root; expected ")
    code, out, err = infgen(*words, "--root", "empty")
    assert (code, out) == (2, "")
    assert "empty: nothing was made there yet" in err
    assert not Path("typo").exists()


@pytest.mark.parametrize("words", NAMING_A_ROOT, ids=named)
def test_a_root_that_is_a_file_is_told_so(infgen, words):  # noqa: F811
    Path("file").write_text("")

    for root in ("file", "file/below"):
        code, _, err = infgen(*words, "--root", root)
        assert code == 2
        assert re.match(rf"infgen: --root {root}(: \S+)? is a file; expected a folder", err)


def test_words_that_are_refused_do_not_come_back(infgen):  # noqa: F811
    words = ("-s", "total.times=3", "--dask", "lokal")
    assert infgen(*RUN, *words)[0] == 2
    assert not list(Path("R").glob("refs/*"))

    infgen(*RUN)
    assert infgen("run", "--root", "R", *words)[0] == 2
    assert infgen("status", "--check", "--root", "R")[0] == 0


def test_json_is_a_line_for_every_run_also_for_one_that_is_refused(infgen):  # noqa: F811
    told = [
        infgen(*RUN, "--json")[1],
        infgen("run", "--root", "R", "--json", "-s", "total.tims=2")[1],
        infgen("run", "--root", "R", "--json", "-n")[1],
    ]

    assert all(text.count("\n") == 1 for text in told)
    made, refused, _ = [json.loads(line) for line in "".join(told).splitlines()]
    assert [stage["state"] for stage in made["stages"]] == ["made"] * 3
    assert refused["exit_code"] == 2
    assert "did you mean 'times'" in refused["error"]


def test_a_dry_run_says_what_is_to_be_made_again(infgen):  # noqa: F811
    infgen(*RUN)

    def states(*words):
        out = infgen("run", "--root", "R", "-n", "--json", *words)[1]
        return [stage["state"] for stage in json.loads(out)["stages"]]

    assert states() == ["cached"] * 3
    assert states("--from", "total") == ["cached", "stale", "stale"]
    assert states("-f") == ["stale"] * 3
    assert infgen("run", "--root", "R", "-n", "--from", "none")[0] == 2


def test_plan_has_no_word_that_changes_nothing(infgen):  # noqa: F811
    infgen(*RUN)

    for word in ("--force", "--wait", "--keep-going", "--dry-run", "--max-bad=1"):
        assert infgen("plan", "--root", "R", word)[0] == 2
    assert infgen("plan", "--root", "R", "--strict-code")[0] == 0


def test_the_version_is_told(infgen):  # noqa: F811
    assert infgen("--version")[:2] == (0, f"infgen {__version__}\n")


def test_the_help_says_where_to_begin_and_what_exit_codes_mean(infgen):  # noqa: F811
    out = infgen("--help")[1]

    assert "infgen demo" in out
    for code in ("0 ", "1 ", "2 ", "3 ", "75 ", "130, 143 "):
        assert re.search(rf"^ +{code} +\w", out, re.MULTILINE)


@pytest.mark.parametrize("verb", VERBS)
def test_no_option_wants_a_list_of_str(infgen, verb):  # noqa: F811
    options = infgen(verb, "--help")[1].partition("\nOptions:")[2]

    assert "list[" not in options


@pytest.mark.parametrize("stage", [name for name in MODULES if name != "ingest"])
def test_the_help_of_a_stage_says_that_it_makes_what_is_missing(infgen, stage):  # noqa: F811
    out = " ".join(infgen(stage, "--help")[1].split())

    assert "Makes first what is missing before it" in out
    assert f"infgen {stage} --root R --profile small -n" in out


def test_every_setting_is_listed_with_its_default_and_what_it_is(infgen):  # noqa: F811
    code, out, _ = infgen("settings", "--file", DEFAULT_FILE, "--json")
    found = {each["name"]: each for each in json.loads(out)["settings"]}

    assert code == 0
    assert found["train.steps"]["default"] == 100_000
    for entry in load_stages(DEFAULT_FILE, {}).stages.values():
        for section, kind in load_stage(entry.module).settings.items():
            for field in fields(kind):
                assert found.pop(f"{section}.{field.name}", {"meaning": True})["meaning"]
    assert not found


def test_settings_of_one_section_or_one_alone(infgen):  # noqa: F811
    Path("stages.yaml").unlink()  # The real stages.

    out = infgen("settings", "ingest")[1]
    assert "ingest.max_scenes_per_file" in out
    assert "train.steps" not in out
    out = infgen("settings", "train.steps")[1]
    assert "100000" in out
    assert "train.learning_rate" not in out
    assert "did you mean 'train'?" in infgen("settings", "trian")[2]
    assert "did you mean 'steps'?" in infgen("settings", "train.stps")[2]
    assert infgen("settings", "trian")[0] == infgen("settings", "train.stps")[0] == 2


def test_settings_of_ones_own_stages_are_listed_too(infgen):  # noqa: F811
    assert "count.longest" in infgen("settings")[1]
