import csv
import json
import re
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from pydantic import ValidationError

from infgen.config import (
    ReferenceSettings,
    ReportSettings,
    RolloutSettings,
    ScoreSettings,
    TokenSettings,
)
from infgen.rollout.rollout import NEVER, Rollout
from infgen.scene import Scene
from infgen.sources.towns import builtin_records
from infgen.sources.womd import iter_scenes
from pipeline.engine.atomic import write_json
from pipeline.engine.stage import FinishedUnit, Stage
from pipeline.stages import reference
from pipeline.stages.reference_files import read_counts
from pipeline.stages.report import histograms
from pipeline.stages.report import stage as report
from pipeline.stages.report.passport import times
from pipeline.stages.score import stage as score
from pipeline.storage.rollouts import ROLLOUTS_SCHEMA
from pipeline.storage.scenes import SCENES_SCHEMA
from pipeline.storage.zarr_store import write_records

SECONDS, SCENES = 12, 2
SOURCE = "validation.tfrecord-00000-of-00001.gz"
REFERENCE = {"tokenize": TokenSettings(), "reference": ReferenceSettings()}
RUN = {
    "host": "node<7>",
    "started": "2026-01-01T00:00:00+00:00",
    "machine": {"processor": "A CPU", "cores": 8, "memory_gib": 31.4, "gpus": ["A GPU"]},
}
SETTINGS = {
    "reference": ReferenceSettings(),
    "score": ScoreSettings(bootstrap_resamples=20),
}


def silent(done, total, note=""):
    pass


class Inputs:
    """Finished stages below a folder, as the engine would show them."""

    sources = ()

    def __init__(self, root: Path, units):
        self._root, self._units = root, units

    def add(self, stage, units):
        self._units[stage] = units

    def units(self, stage):
        return self._units.get(stage, [])

    def folder(self, stage):
        return self._root / stage

    def key(self, stage):
        return f"key of {stage}"

    def content(self, stage, *names):
        return f"content of {stage}"


def cruise(scene: Scene, index: int) -> Rollout:
    """Everyone seen now goes on at their speed; one more joins them half way."""
    tracks, steps = scene.tracks, scene.now + 10 * SECONDS + 1
    rows = np.flatnonzero(tracks.valid[:, scene.now])
    after_s = 0.1 * (np.arange(steps) - scene.now)[None, :, None]
    xyz_m = np.repeat(tracks.xyz_m[rows, scene.now][:, None], steps, axis=1)
    xyz_m[..., :2] += tracks.velocity_mps[rows, scene.now][:, None] * after_s
    rows, xyz_m = np.append(rows, scene.ego), np.concatenate([xyz_m, xyz_m[-1:] + 5])
    valid = np.ones((len(rows), steps), bool)
    valid[-1, : steps // 2 + index] = False
    heading_rad = np.repeat(tracks.heading_rad[rows, scene.now][:, None], steps, axis=1)
    return Rollout(
        scenario_id=scene.scenario_id,
        index=index,
        seed=index,
        weights="none",
        origin_xyz_m=scene.origin_xyz_m,
        now=scene.now,
        ego=int(np.flatnonzero(rows == scene.ego)[0]),
        id=np.append(tracks.id[rows[:-1]], tracks.id.max() + 1).astype(np.int32),
        agent_type=tracks.agent_type[rows],
        size_lwh_m=tracks.size_lwh_m[rows, scene.now],
        xyz_m=np.where(valid[..., None], xyz_m, 0).astype(np.float32),
        heading_rad=np.where(valid, heading_rad, 0).astype(np.float32),
        valid=valid,
        logged=np.arange(len(rows)) < len(rows) - 1,
        entry_step=np.append(np.zeros(len(rows) - 1), steps // 2 + index - 1).astype(
            np.int16
        ),
        exit_step=np.full(len(rows), NEVER, dtype=np.int16),
    )


def manifest(root: Path, stage: Stage | str, settings, told, units=(), sources=()) -> None:
    """Write what the engine writes last into a stage's folder."""
    name = stage if isinstance(stage, str) else stage.name
    (root / name).mkdir(parents=True, exist_ok=True)
    about = {
        "stage": name,
        "key": f"{name}-0123456789abcdef",
        "version": 1,
        "code": "c0de" * 16,
        "packages": {"python": "3.11", "numpy": "2"},
        "settings": settings,
        "sources": dict.fromkeys(sources, "f1nger"),
        "units": [{"name": unit.name, "key": unit.key} for unit in units],
        "report": told,
        "files": {"x": [1000, "c4c"]},
    }
    write_json(root / name / "manifest.json", about)
    for number, folder in enumerate([root / name, *[unit.path for unit in units]]):
        if number:
            write_json(folder / "manifest.json", {"files": {"y": [500, "c4c"]}})
        about = {**RUN, "seconds": 2.5 * (number + 1)}
        if name == "rollout" and number:
            about["report"] = {"device": "NVIDIA <H100> 80GB HBM3, TF32"}
        write_json(folder / "run.json", about)


def finished(root: Path) -> Inputs:
    """Run the stages that the report reads closely; the others only left a manifest."""
    scenes = [
        scene
        for scene, _ in zip(iter_scenes(builtin_records()[-1]), range(SCENES), strict=False)
    ]
    rollouts = [cruise(scene, index) for scene in scenes for index in range(2)]
    logs = FinishedUnit(SOURCE, "k1", root / "units" / "logs", {"scenes": len(scenes)})
    played = FinishedUnit(
        f"{SOURCE}-00000", "k2", root / "units" / "played", {"rollouts": 4}
    )
    for done in (logs, played):
        done.path.mkdir(parents=True)
    write_records(
        logs.path / "scenes-000.zarr", scenes, Scene, SCENES_SCHEMA, compress=True
    )
    write_records(
        played.path / "rollouts-000.zarr", rollouts, Rollout, ROLLOUTS_SCHEMA, compress=True
    )
    ids = pl.DataFrame({"scenario_id": [one.scenario_id for one in rollouts]})
    ids.write_parquet(played.path / "index.parquet")
    inputs = Inputs(root, {"ingest": [logs], "rollout": [played]})
    (root / "ingest").mkdir()
    bad = {
        "source": ["<a>.tfrecord"],
        "record": [3],
        "offset": [77],
        "reason": ["| broken"],
    }
    pl.DataFrame(bad).write_parquet(root / "ingest" / "quarantine.parquet")
    _score(root, inputs)
    (played.path / "index.parquet").unlink()  # The report reads the one of all units.
    (root / "rollout").mkdir()
    unit = pl.lit(played.name).alias("unit")
    ids.with_columns(unit).write_parquet(root / "rollout" / "index.parquet")
    (root / "train").mkdir()
    lines = [
        {"step": step, "learning_rate": 0.1, "motion": 7.0 / step} for step in (1, 2, 3)
    ]
    validation_split = {"keep_count": 40.0, "keep_predicted": 0.2, "keep_logged": 0.25}
    text = "".join(
        json.dumps(line) + "\n"
        for line in [*lines, {"step": 3, "validation": validation_split}]
    )
    (root / "train" / "train.jsonl").write_text(text)
    manifest(
        root,
        "ingest",
        {"ingest": {"max_scenes_per_file": 0}},
        {"scenes": 2},
        [logs],
        [SOURCE],
    )
    manifest(root, "build-vocab", {"build-vocab": {"seed": 0}}, {})
    write_json(root / "build-vocab" / "report.json", {"motion": {"vehicle": {"real": 12}}})
    manifest(root, "tokenize", {"tokenize": asdict(TokenSettings())}, {"words": 5})
    manifest(root, "train", {"train": {"steps": 3}}, {"weights": "feedc0ffee"})
    (root / "calibrate").mkdir()
    manifest(root, "calibrate", {"calibrate": {"by": "odds"}}, {"add_bias": 0.25})
    manifest(
        root,
        "rollout",
        {"rollout": asdict(RolloutSettings())},
        {"rollouts": 4, "device": "cuda"},
        [played],
    )
    return inputs


def _score(root: Path, inputs: Inputs) -> None:
    done = _do(reference, root, inputs, REFERENCE)
    inputs.add("reference", done)
    told = reference.finish(inputs, done, root / "reference", REFERENCE, silent)
    manifest(root, "reference", {"reference": {"window_s": 8.0}}, told, done)
    done = _do(score, root, inputs, SETTINGS)
    (root / "score").mkdir()
    inputs.add("score", done)
    told = score.finish(inputs, done, root / "score", SETTINGS, silent)
    settings = {name: asdict(value) for name, value in SETTINGS.items()}
    manifest(root, "score", settings, told, done)


def _do(stage, root: Path, inputs: Inputs, settings) -> list[FinishedUnit]:
    done = []
    for unit in stage.plan(inputs, settings):
        target = root / "units" / f"{stage.STAGE.name}-{unit.name}"
        told = json.loads(json.dumps(stage.work(unit, target, settings, silent)))
        done.append(FinishedUnit(unit.name, unit.name, target, told))
    return done


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("root"))


def write(inputs, folder: Path, **changes):
    settings = replace(ReportSettings(), **changes)
    assert report.plan(inputs, settings) == []
    told = report.finish(inputs, [], folder, settings, silent)
    files = {path.name: path.read_text("latin-1") for path in folder.glob("*.pdf")}
    texts = [path for path in sorted(folder.glob("*.*")) if path.name not in files]
    files |= {path.name: path.read_text() for path in texts}
    below = {
        f"{path.parent.name}/{path.name}": path.read_text()
        for path in sorted(folder.glob("*/*"))
    }
    return told, {**files, **below}


@pytest.fixture(scope="module")
def written(inputs, tmp_path_factory):
    return write(inputs, tmp_path_factory.mktemp("report") / "out")


@pytest.fixture(scope="module")
def summary(inputs):
    return json.loads((inputs.folder("score") / "summary.json").read_text())


def test_the_report_comes_in_six_forms(written):
    told, files = written

    assert (
        files["figures.pdf"].count("/MediaBox")
        == files["report.html"].count("<figure>") - 2
    )
    assert sorted(name for name in files if "/" not in name) == [
        "figures.pdf",
        "report.html",
        "report.md",
        "table.csv",
        "table.json",
        "table.tex",
    ]
    assert told["scenes"] == SCENES
    assert told["rollouts"] == 2 * SCENES
    assert 0 < told["composite_corrected"] < 1


def test_the_table_holds_the_scores_of_the_summary(written, summary):
    table = json.loads(written[1]["table.json"])
    rows = {row[0]: dict(zip(table["columns"], row, strict=True)) for row in table["rows"]}

    for protocol in ("paper", "corrected"):
        entry = summary["protocols"][protocol]["scores"]["composite"]
        assert rows[f"composite ({protocol})"]["rollouts"] == pytest.approx(
            entry["mean"], abs=1e-6
        )
        assert rows[f"composite ({protocol})"]["log"] == pytest.approx(
            entry["log"], abs=1e-6
        )
    ace = summary["numbers"]["ace/own_near"]["mean"]
    assert rows["Mean ACE, own log, near"]["rollouts"] == pytest.approx(ace, abs=1e-6)


def test_proper_scores_stand_in_the_table_and_in_tables_of_their_own(written, summary):
    _, files = written
    table = json.loads(files["table.json"])
    rows = {row[0]: dict(zip(table["columns"], row, strict=True)) for row in table["rows"]}
    energy = summary["proper"]["numbers"]["energy"]

    row = rows["energy score of counts (proper)"]
    assert row["rollouts"] == pytest.approx(energy["mean"], abs=1e-6)
    assert row["95 % interval"] == f"{energy['low']:.4f} to {energy['high']:.4f}"
    assert "<h2>By protocol proper</h2>" in files["report.html"]
    counts = files["tables/proper-scores-of-counts-around-the-ego.csv"]
    assert counts.splitlines()[1].startswith("all counts by type and ring")
    traffic = files[
        "tables/traffic-as-engineers-judge-it-rollouts-against-their-logs-proper.md"
    ]
    assert "| stop duration | s | not measured | - |" in traffic  # Nobody ever stops.


def test_published_numbers_stand_beside_the_papers_protocol_only(written):
    table = json.loads(written[1]["table.json"])
    rows = {row[0]: dict(zip(table["columns"], row, strict=True)) for row in table["rows"]}

    assert rows["composite (paper)"]["published InfGen"] == 0.6606
    assert rows["composite (paper)"]["published CatK"] == 0.6584
    assert rows["composite (corrected)"]["published InfGen"] is None
    assert rows["Mean ACE, own log, near"]["published SMART-7M"] == 12.0
    assert "compare directions, not digits" in written[1]["report.html"]


def test_all_forms_of_the_table_agree(written):
    files = written[1]
    table = json.loads(files["table.json"])
    rows = list(csv.reader(files["table.csv"].splitlines()))

    assert rows[0] == table["columns"]
    assert [row[0] for row in rows[1:]] == [row[0] for row in table["rows"]]
    for row in table["rows"]:
        assert row[0] in files["report.md"]
    assert files["table.tex"].count(r"\begin{table}") == 8


def test_the_page_stands_alone(written):
    page = written[1]["report.html"]

    assert page.startswith("<!doctype html>")
    linked = set(re.findall(r'(?:src|href)\s*=\s*"([^"#][^"]*)"', page))
    assert "run/passport.html" in linked
    assert linked <= written[1].keys()
    assert not re.findall(r"@import|url\((?!#)|<script|https?://(?!www\.w3)", page)
    assert page.count("<svg") == page.count("</svg>")
    assert "nan" not in re.findall(r'd="([^"]*)"', page)


def test_the_page_draws_errors_counts_scores_training_and_a_rollout(written):
    titles = re.findall(r"<title>([^<]*)</title>", written[1]["report.html"])

    assert titles[0] == "InfGen"
    assert "Agent count error (ACE) by window" in titles
    assert "Agents by window" in titles
    assert "Scores by window (corrected)" in titles
    assert "Score of each feature (paper)" in titles
    assert {"Motion token", "Removal: predicted and logged"} <= set(titles)
    assert any(title.startswith("Rollout 0 of") for title in titles)
    assert any(title.startswith("Log of") for title in titles)


def test_the_rollout_is_drawn_every_six_seconds_and_at_its_end(written):
    times = re.findall(r">t = ([\d.]+) s", written[1]["report.html"])

    assert times == ["0", "6", "8", "0", "6", "12"]


def test_the_passport_names_keys_settings_versions_weights_and_quarantine(written):
    page = written[1]["report.html"]

    for words in (
        "feedc0ffee",
        "score-0123456789",
        "tokenize: tokenize.grid_radius_m",
        "numpy",
        SOURCE,
        "motion.vehicle.real",
        "1 of 1; all are in quarantine.parquet",
    ):
        assert words in page


def test_every_table_comes_as_markdown_latex_and_csv(written):
    files = written[1]
    titles = re.findall(r"<h3>([^<]*)</h3>", files["report.html"])
    tables = {name for name in files if name.startswith("tables/")}

    assert len(tables) == 3 * (len(titles) + 1)  # And the histograms, which are drawn.
    assert files["tables/scores.csv"] == files["table.csv"]
    assert files["tables/scores.md"] in files["report.md"]
    assert files["tables/stages.tex"].startswith(r"\begin{table}")


def test_histograms_of_logs_and_rollouts_are_drawn_and_listed(written, inputs):
    page, listed = (written[1][name] for name in ("report.html", "tables/histograms.csv"))
    rows = list(csv.DictReader(listed.splitlines()))

    drawn = re.findall(r"<title>([^<]*)</title>", page)
    assert {"Speed", "Collision", "Off-road", "Distance at entry"} <= set(drawn)
    fast = [
        row
        for row in rows
        if (row["feature"], row["protocol"]) == ("linear_speed", "corrected")
    ]
    assert [float(row["to"]) for row in fast] == [2.5 * i for i in range(1, 11)]
    bins = read_counts(inputs.folder("reference")).bins[1, 0, :10]
    assert [int(row["logs"]) for row in fast] == bins.tolist()
    assert sum(int(row["rollouts"]) for row in fast) > 0


def test_histograms_are_read_from_two_files_whatever_the_number_of_units(inputs):
    none = Inputs(inputs.folder("score").parent, {})

    logs, rollouts = histograms.read_both(none)

    _, scored = inputs.units("score")  # The first scored the logs.
    assert rollouts.bins.tolist() == read_counts(scored.path).bins.tolist()
    assert logs.bins.sum() > 0


def test_the_passport_counts_the_bytes_of_stages_and_their_units(written):
    rows = {
        row["stage"]: int(row["bytes"])
        for row in csv.DictReader(written[1]["tables/stages.csv"].splitlines())
    }

    assert rows["train"] == 1000
    assert rows["ingest"] == rows["rollout"] == 1000 + 500


def test_machines_and_times_stand_on_a_page_beside_the_report(written):
    page = written[1]["run/passport.html"]

    assert "node&lt;7&gt;" in page
    for words in ("A CPU", "A GPU", "31.40", "2026-01-01T00:00:00+00:00"):
        assert words in page
    assert re.search(r"ingest</td>.*?5.0000</td><td>5.0000</td><td>2.5000", page)


def test_the_type_of_device_is_in_the_report_and_its_name_on_the_page_beside_it(written):
    counts = written[1]["tables/counts.csv"].splitlines()
    page = written[1]["run/passport.html"]

    assert "rollout: device,cuda" in counts
    assert "NVIDIA &lt;H100&gt; 80GB HBM3, TF32" in page
    assert not [name for name in written[1] if "H100" in written[1][name]][1:]


def test_the_lowest_rollouts_are_linked_to_pages_that_play_them(written):
    page = written[1]["report.html"]
    players = {name for name in written[1] if name.startswith("players/")}
    rows = list(
        csv.reader(written[1]["tables/lowest-composites-corrected.csv"].splitlines())
    )

    assert len(players) == 3
    for scene, index, _ in rows[1:4]:
        name = f"players/{scene}-{index}.html"
        assert f'<a href="{name}">{scene}</a>' in page
        assert f"rollout {index}" in written[1][name]
    assert page.count('<a href="players/') == 3


def test_settings_give_the_title_which_is_escaped_and_the_players(inputs, tmp_path):
    _, files = write(inputs, tmp_path / "out", title="<b>Ours</b>", player_pages=0)

    assert "<h1>&lt;b&gt;Ours&lt;/b&gt;</h1>" in files["report.html"]
    assert files["report.md"].startswith("# &lt;b&gt;Ours&lt;/b&gt;")
    assert not [name for name in files if name.startswith("players/")]
    assert '<a href="players/' not in files["report.html"]
    with pytest.raises(ValidationError, match="player_pages"):
        ReportSettings(player_pages=-1)


def test_times_that_are_lost_are_left_out(inputs):
    ((done, _),) = [(done, done.path / "run.json") for done in inputs.units("ingest")]
    kept = (done.path / "run.json").read_text()
    (done.path / "run.json").write_text("{")
    try:
        found = times(inputs, report.STAGES)
    finally:
        (done.path / "run.json").write_text(kept)

    (row,) = [row for table in found for row in table.rows if row[0] == "ingest"]
    assert None in row


def test_what_records_say_is_escaped_everywhere(written):
    files = written[1]

    assert "&lt;a&gt;.tfrecord" in files["report.html"]
    assert "<a>" not in files["report.html"]
    assert r"\| broken" in files["report.md"]


def test_the_same_inputs_give_the_same_bytes(inputs, written, tmp_path):
    _, again = write(inputs, tmp_path / "out")

    assert again == written[1]


@pytest.mark.parametrize(
    ("mode", "insert", "table"),
    [("long", None, 2), ("long", False, 3), ("motion-only", None, 3), ("wosac", None, 3)],
)
def test_rollouts_without_entries_stand_beside_the_papers_third_table(
    summary, mode, insert, table
):
    settings = asdict(RolloutSettings(mode=mode, insert=insert, remove=insert))

    _, long_term, *_ = report.score_tables(summary, {"rollout": {"settings": settings}})

    text = long_term.to_markdown()
    assert f"paper's table {table}" in text
    assert ("0.7432" in text) == (table == 3)


def test_a_report_without_any_score_still_says_so(tmp_path, inputs, summary):
    empty = json.loads(json.dumps(summary))
    for part in empty["protocols"].values():
        for entry in part["scores"].values():
            entry.update(mean=None, low=None, high=None, log=None)
    empty["numbers"], empty["wosac"]["scores"] = {}, {}
    root = tmp_path / "root"
    for stage in report.STAGES:
        shutil.copytree(inputs.folder(stage), root / stage)
    write_json(root / "score" / "summary.json", empty)
    schema = {"metric": pl.String, "window": pl.Int32, "value": pl.Float64}
    pl.DataFrame(schema=schema).write_parquet(root / "score" / "curves.parquet")
    (root / "train" / "train.jsonl").unlink()

    told, files = write(Inputs(root, {"ingest": [], "rollout": []}), tmp_path / "out")

    assert told["composite_paper"] is None
    assert told["mean_ace"] is None
    assert json.loads(files["table.json"])["rows"][0][1] is None


def test_the_stage_has_no_units():
    unit_free = report.STAGE

    assert unit_free.name == "report"
    assert set(unit_free.settings) == {"report"}
    with pytest.raises(ValueError, match="no unit"):
        report.work(report.Unit("x", {}, {}), Path("nowhere"), ReportSettings(), silent)
