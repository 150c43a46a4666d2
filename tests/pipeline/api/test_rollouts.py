"""Rollouts as tables, arrays, folders, pages: nothing of them is lost."""

import json
import shutil
import sys
from dataclasses import fields
from html import unescape

import numpy as np
import polars as pl
import pytest

import infgen
from cli import main
from infgen.errors import ConfigError, MissingExtraError
from pipeline.engine.atomic import StoreError, write_json
from tests.exports.replays import replay


def assert_equal(one, other):
    for field in fields(one):
        value, expected = getattr(one, field.name), getattr(other, field.name)
        np.testing.assert_array_equal(value, expected, strict=isinstance(value, np.ndarray))


@pytest.fixture(scope="module")
def saved(rollouts, tmp_path_factory):
    return rollouts.save(tmp_path_factory.mktemp("saved") / "rollouts")


def test_rollouts_are_a_sequence_with_their_scene(rollouts, scene):
    assert len(rollouts) == 2
    assert [one.index for one in rollouts] == [0, 1]
    assert rollouts[1] is rollouts.rollouts[1]
    assert len(rollouts[1:]) == 1
    assert rollouts[1:].scene is scene
    assert repr(rollouts) == f"SceneRollouts(scene {scene.scenario_id}, 2 rollouts of 8 s)"


def test_a_table_has_a_row_for_every_step_of_every_agent(rollouts, scene):
    table = rollouts.to_polars()

    assert table.height == sum(int(one.valid.sum()) for one in rollouts)
    assert table["scenario_id"].unique().to_list() == [scene.scenario_id]
    ego = table.filter("is_ego", pl.col("rollout") == 1).sort("step")
    np.testing.assert_allclose(
        ego.select("x_m", "y_m", "z_m").to_numpy() - scene.origin_xyz_m,
        rollouts[1].xyz_m[rollouts[1].ego],
        atol=1e-9,
    )
    assert ego["time_s"].to_list() == [round(0.1 * (at - scene.now), 1) for at in range(91)]


def test_a_dataset_holds_every_agent_and_nan_where_nobody_is(rollouts, scene):
    pytest.importorskip("xarray", reason="the extra xarray is not installed")
    dataset = rollouts.to_xarray()

    assert dataset.sizes["rollout"] == 2
    assert dataset.sizes["step"] == 91
    for at, one in enumerate(rollouts):
        agents = len(one.id)
        here = dataset.isel(rollout=at)
        np.testing.assert_array_equal(here["id"][:agents], one.id)
        assert (here["id"][agents:] == -1).all()
        np.testing.assert_array_equal(here["valid"][:agents], one.valid)
        assert int(here["valid"].sum()) == one.valid.sum()
        x_m = np.where(one.valid, one.xyz_m[..., 0] + scene.origin_xyz_m[0], np.nan)
        np.testing.assert_allclose(here["x_m"][:agents], x_m, rtol=0, atol=1e-9)


def test_without_xarray_the_way_to_it_is_told(rollouts, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)  # What is not installed.

    with pytest.raises(MissingExtraError, match=r"pip install 'infgen\[xarray\]'"):
        rollouts.to_xarray()


def test_what_is_saved_is_read_again_with_scene_and_settings(rollouts, saved):
    again = infgen.open_rollouts(saved)

    assert again.settings == rollouts.settings
    assert len(again) == len(rollouts)
    for one, other in zip(again, rollouts, strict=True):
        assert_equal(one, other)
    assert_equal(again.scene.tracks, rollouts.scene.tracks)
    assert infgen.open_scenes(saved)[0].scenario_id == rollouts.scene.scenario_id


def test_nothing_is_written_over(rollouts, saved):
    with pytest.raises(ConfigError, match="exists; remove it, or name another"):
        rollouts.save(saved)
    with pytest.raises(ConfigError, match="holds no rollouts; expected a folder that"):
        infgen.open_rollouts(saved.parent)


def test_a_folder_of_another_schema_is_refused(saved, tmp_path):
    copy = shutil.copytree(saved, tmp_path / "saved")
    manifest = json.loads((copy / "manifest.json").read_text())
    write_json(copy / "manifest.json", {**manifest, "schema": "infgen.saved-rollouts/0"})

    with pytest.raises(StoreError, match=r"holds 'infgen\.saved-rollouts/0', expected"):
        infgen.open_rollouts(copy)


def test_rollouts_of_arrays_are_saved_without_settings(scene, tmp_path):
    replayed = infgen.SceneRollouts(scene, (replay(scene),))

    assert infgen.open_rollouts(replayed.save(tmp_path / "replay")).settings is None


@pytest.mark.parametrize(
    "words",
    [
        "view {saved} --rollouts 1 --out {out}/page.html",
        "export {saved} --to parquet --out {out}/table",
        "export {saved} --to gpudrive --out {out}/gpudrive",
    ],
)
def test_commands_read_saved_rollouts(saved, tmp_path, words):
    with pytest.raises(SystemExit) as left:
        main(words.format(saved=saved, out=tmp_path).split())

    assert not left.value.code
    assert any(path.is_file() for path in tmp_path.rglob("*"))


def test_saved_rollouts_are_scored_by_the_command(scene, tmp_path, capsys):
    replayed = infgen.SceneRollouts(scene, (replay(scene), replay(scene, index=1)))
    saved = str(replayed.save(tmp_path / "replay"))

    with pytest.raises(SystemExit) as left:
        main(["wosac", saved, saved, "--json"])

    assert not left.value.code
    found = json.loads(capsys.readouterr().out)["scenarios"][scene.scenario_id]
    assert found == dict(replayed.score())


def test_an_exported_table_is_that_of_the_facade(rollouts, saved, tmp_path):
    with pytest.raises(SystemExit):
        main(["export", str(saved), "--to", "parquet", "--out", str(tmp_path / "table")])

    (path,) = (tmp_path / "table").rglob("*.parquet")
    exported = pl.read_parquet(path, hive_partitioning=False)
    assert exported.equals(rollouts.to_polars().drop("scenario_id"))


def test_a_page_shows_itself_in_a_notebook(rollouts, tmp_path):
    page = rollouts.view(tmp_path / "pages" / "scene.html", most=1)

    text = (tmp_path / "pages" / "scene.html").read_text()
    shown = page._repr_html_()
    assert str(page) == str(page.path)
    assert shown.startswith('<iframe srcdoc="')
    assert unescape(shown.split('"')[1]) == text
    assert "log, rollout 0." in text
    with open(page) as file:
        assert file.read() == text


def test_strips_and_videos_are_written(rollouts, tmp_path):
    pytest.importorskip("aggdraw", reason="the extra video is not installed")

    assert rollouts.strip(tmp_path / "strip.svg").read_text().startswith("<svg")
    short = infgen.SceneRollouts(rollouts.scene, rollouts.rollouts)
    video = short.video(tmp_path / "film.gif", size_px=(240, 240), most=1, log=False)
    assert video.read_bytes()[:4] == b"GIF8"
