import json
import re
import xml.etree.ElementTree as ET

import pytest

from infgen.errors import ConfigError
from pipeline.stages.report.training import (
    compare,
    find_log,
    main,
    read_run,
    training_figures,
)

BINS = {"count": [6, 4], "predicted": [0.6, 2.0], "happened": [1, 2], "edges": [0, 0.3, 1]}


def log(folder, *lines):
    folder.mkdir(parents=True)
    path = folder / "train.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def step(at, **figures):
    return {"step": at, "learning_rate": 0.1, **figures}


@pytest.fixture
def path(tmp_path):
    return log(
        tmp_path / "work" / "latest" / "train",
        step(10, motion=7.0, motion_count=100.0, motion_accuracy=0.1),
        step(20, motion=5.0, motion_count=300.0, motion_accuracy=0.3, add=0.5),
        {"step": 20, "validation": {"motion": 6.0, "total": 9.0}},
        step(30, motion=4.0, motion_count=200.0, motion_accuracy=0.5),
        {"step": 30, "validation": {"motion": 5.0, "total": 8.0, "keep_bins": BINS}},
        {"step": 30, "validation": {}},
    )


def test_a_log_is_read_into_curves_over_its_steps(path):
    run = read_run(path, "mine")

    assert run.train["motion"].x.tolist() == [10, 20, 30]
    assert run.train["motion"].y.tolist() == [7, 5, 4]
    assert run.validation["total"].y.tolist() == [9, 8]
    assert run.weight["motion_accuracy"].tolist() == [100, 300, 200]


def test_a_figure_that_a_step_lacks_is_unknown_there(path):
    assert [str(y) for y in read_run(path, "mine").train["add"].y] == ["nan", "0.5", "nan"]


def test_bins_are_those_of_the_last_validation(path):
    bins = read_run(path, "mine").bins["keep"]

    assert (bins.count.tolist(), bins.happened.tolist()) == ([6, 4], [1, 2])


def test_where_only_overall_rates_are_known_they_are_one_bin(tmp_path):
    rates = {"add_count": 50.0, "add_predicted": 0.2, "add_logged": 0.3}
    path = log(tmp_path / "old", step(1, motion=1.0), {"step": 1, "validation": rates})

    bins = read_run(path, "old").bins["add"]

    assert (bins.count[0], bins.predicted[0], bins.happened[0]) == pytest.approx(
        (50, 10, 15)
    )


def test_a_run_is_a_log_a_folder_or_a_root_and_may_be_named(path):
    root = path.parents[2]

    for word in (path, path.parent, root):
        assert find_log(str(word)) == ("work", path)
        assert find_log(f"InfGen={word}") == ("InfGen", path)


def test_a_word_that_is_no_run_is_refused_by_name(tmp_path):
    with pytest.raises(ConfigError, match=r"nothing: no train\.jsonl here"):
        find_log(f"a={tmp_path / 'nothing'}")


@pytest.mark.parametrize("suffix", [".svg", ".html"])
def test_runs_are_compared_in_one_file_with_the_same_bytes_each_time(
    path, tmp_path, suffix
):
    other = log(tmp_path / "smart", step(10, motion=6.0), step(30, motion=5.0))
    target = tmp_path / f"out{suffix}"

    main([f"InfGen={path}", f"SMART={other}", "--out", str(target), "--title", "<Both>"])
    first = target.read_text()
    main([f"InfGen={path}", f"SMART={other}", "--out", str(target), "--title", "<Both>"])

    assert target.read_text() == first
    assert "&lt;Both&gt;" in first
    assert {"InfGen", "SMART", "Motion token"} <= set(
        re.findall(r">([^<>]+)</text>", first)
    )
    if suffix == ".svg":
        ET.fromstring(first)


def test_another_suffix_is_refused(path, tmp_path):
    with pytest.raises(ConfigError, match=r"\.svg, \.pdf or \.html"):
        compare([str(path)], tmp_path / "out.png", "t")


def test_the_command_says_what_is_wrong_and_exits_2(tmp_path, capsys):
    with pytest.raises(SystemExit) as left:
        main([str(tmp_path), "--out", str(tmp_path / "a.svg")])

    assert left.value.code == 2
    assert "no train.jsonl here" in capsys.readouterr().err


def test_without_a_log_nothing_is_drawn(tmp_path):
    assert training_figures(tmp_path / "train.jsonl", "mine") == []
