"""``infgen view``: from the command line to a page, from a root and from records."""

import json
import shutil

import polars as pl
import pytest

from cli import main
from infgen.errors import ConfigError
from infgen.rollout.rollout import Rollout
from infgen.views.player.payload import unpack
from pipeline.commands.view import Wanted, find_view_model, view
from pipeline.engine.atomic import write_json
from pipeline.engine.layout import Root, link
from pipeline.storage.rollouts import ROLLOUTS_SCHEMA
from pipeline.storage.scene_rollouts import choose
from pipeline.storage.scenes import file_name
from pipeline.storage.zarr_store import write_records
from tests.exports.replays import replay, with_newcomer

KEY = "ab" * 32
COUNT = 5


def infgen(*words):
    with pytest.raises(SystemExit) as left:
        main([str(word) for word in words])
    return left.value.code or 0


@pytest.fixture(scope="module")
def ingested(source, tmp_path_factory):
    """A root that holds the scenes of one file, and nothing more."""
    root = tmp_path_factory.mktemp("ingested") / "root"
    assert infgen("ingest", source, "--root", root) == 0
    return root


@pytest.fixture(scope="module")
def played(ingested, scenes, tmp_path_factory):
    """The same with rollouts of its second and third scene."""
    path = tmp_path_factory.mktemp("played") / "root"
    shutil.copytree(ingested, path, symlinks=True)
    root, units = Root(path), []
    for at, scene in enumerate(scenes[1:3]):
        name, key = f"unit-{at}", f"{at}{KEY[1:]}"
        folder = root.unit("rollout", key)
        folder.mkdir(parents=True)
        rollouts = [with_newcomer(replay(scene, i), 30 + i) for i in range(COUNT)]
        write_records(
            folder / "rollouts-000.zarr", rollouts, Rollout, ROLLOUTS_SCHEMA, compress=True
        )
        units.append((name, key, scene.scenario_id))
    made = root.folder("rollout", KEY)
    made.mkdir(parents=True)
    rows = [(each, i, name) for name, _, each in units for i in range(COUNT)]
    index = pl.DataFrame(rows, ["scenario_id", "rollout", "unit"], orient="row")
    index.write_parquet(made / "index.parquet")
    about = [{"name": name, "key": key} for name, key, _ in units]
    write_json(made / "manifest.json", {"files": {}, "units": about, "report": {}})
    link(root.latest / "rollout", made)
    return path


def names(view_model):
    return [showing.name for showing in view_model.showings]


def test_where_nothing_is_named_the_first_rollouts_and_their_log_are_shown(played, scenes):
    view_model = find_view_model(Wanted(Root(played)))

    assert view_model.scenario_id == scenes[1].scenario_id
    assert names(view_model) == ["log", "rollout 0", "rollout 1", "rollout 2"]


def test_a_scene_is_found_by_the_start_of_its_id(played, scenes):
    wanted = scenes[2].scenario_id

    assert find_view_model(Wanted(Root(played), scene=wanted)).scenario_id == wanted


def test_the_rollouts_that_are_asked_for_are_shown_in_that_order(played):
    view_model = find_view_model(Wanted(Root(played), rollouts=(4, 1), log=False))

    assert names(view_model) == ["rollout 4", "rollout 1"]


def test_a_scene_without_rollouts_is_shown_as_its_log(played, ingested, scenes):
    first = scenes[0].scenario_id

    assert names(find_view_model(Wanted(Root(played), scene=first))) == ["log"]
    assert find_view_model(Wanted(Root(ingested))).scenario_id == first
    assert names(find_view_model(Wanted(Root(played), rollouts=()))) == ["log"]


def test_a_log_needs_no_root(source, scenes, tmp_path):
    second = scenes[1].scenario_id
    view_model = find_view_model(
        Wanted(Root(tmp_path), records=(str(source),), scene=second)
    )

    assert view_model.scenario_id == second
    assert names(view_model) == ["log"]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"scene": "nosuch"}, "no scene of .* starts with 'nosuch'; there is {first}, "),
        ({"rollouts": (7,)}, "{second} has no rollout 7; there is 0, 1, 2, 3, 4"),
        ({"rollouts": (), "log": False}, "leaves nothing to show"),
        ({"records": ("a",), "rollouts": (1,)}, "records hold no rollouts"),
        ({"records": ("nosuch.tfrecord",)}, "no records match nosuch.tfrecord"),
        ({"every_s": 0.0}, "--every 0.0: expected 0.1 s or more"),
    ],
)
def test_wrong_words_are_told_with_the_way_out(played, scenes, changed, message):
    first, second = scenes[0].scenario_id, scenes[1].scenario_id

    with pytest.raises(ConfigError, match=message.format(first=first, second=second)):
        find_view_model(Wanted(Root(played), **changed))


def test_of_many_scenes_that_begin_alike_some_are_named():
    with pytest.raises(ConfigError, match=r"2 scenes of here .* 'ab': abc, abd; give more"):
        choose(["abc", "abd", "x"], "ab", "here")
    assert choose(["ab", "abd"], "ab", "here") == "ab"
    with pytest.raises(ConfigError, match=r"'ax'.*there is abcd, abce"):
        choose(["abcd", "abce"], "ax", "here")


def test_a_scene_that_no_record_holds_is_told_with_some_that_there_are(source, scenes):
    with pytest.raises(
        ConfigError, match=f"these records .*'x'; there is .*{scenes[0].scenario_id}"
    ):
        find_view_model(Wanted(Root(source), records=(str(source),), scene="x"))


def test_a_file_without_records_says_what_is_wrong_with_it(tmp_path, capsys):
    path = tmp_path / "x.tfrecord"
    path.write_text("nothing of the kind, and long enough")

    assert infgen("view", path) == 2
    assert "no usable record: " in (err := capsys.readouterr().err)
    assert f"{path}, record 0: length checksum" in err


@pytest.mark.parametrize("name", ["nosuch", "empty", "note.txt"])
def test_what_is_neither_a_root_nor_records_is_told_so(tmp_path, capsys, name):
    (tmp_path / "empty").mkdir()

    assert infgen("view", tmp_path / name) == 2
    assert f"{name} is neither a root nor records; expected" in capsys.readouterr().err


def test_an_empty_root_says_how_to_fill_it(tmp_path):
    with pytest.raises(ConfigError, match="holds no scenes; `infgen demo` makes some"):
        find_view_model(Wanted(Root(tmp_path)))
    with pytest.raises(ConfigError, match="holds no rollouts; `infgen rollout --root"):
        find_view_model(Wanted(Root(tmp_path), rollouts=(1,)))


def test_the_verb_writes_a_page_and_prints_its_path(
    played, scenes, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    second = scenes[1].scenario_id

    assert infgen("view", played) == 0
    assert capsys.readouterr().out.strip() == f"{second}.html"
    html = (tmp_path / f"{second}.html").read_text()
    packed = html.split('type="text/plain">')[1].split("<")[0]
    assert names(unpack(packed)) == ["log", "rollout 0", "rollout 1", "rollout 2"]
    assert [each.name for each in tmp_path.iterdir()] == [f"{second}.html"]


def test_the_verb_takes_records_and_options_and_tells_in_json(
    source, scenes, tmp_path, capsys
):
    page = tmp_path / "deep" / "log.html"
    third = scenes[2].scenario_id

    code = infgen("view", source, "--scene", third, "--out", page, "--json")

    assert code == 0
    told = json.loads(capsys.readouterr().out)
    assert told == {
        "scene": third,
        "showings": ["log"],
        "files": [[str(page), page.stat().st_size]],
    }


def test_where_a_strip_is_asked_for_no_page_is_written(played, tmp_path):
    done = view(Wanted(Root(played), strip=tmp_path / "strip.svg", every_s=4.0))

    assert [path for path, _ in done.files] == [str(tmp_path / "strip.svg")]
    assert [each.name for each in tmp_path.iterdir()] == ["strip.svg"]


@pytest.mark.parametrize(
    "words",
    [
        ["--rollouts", "one"],
        ["--size", "big"],
        ["--size", "641x480"],
        ["--theme", "blue"],
        ["--video", "film.avi"],
        ["--strip", "strip.pdf"],
    ],
)
def test_the_verb_leaves_with_two_for_wrong_words(played, words, capsys):
    assert infgen("view", played, *words) == 2
    assert words[1].split("x")[0].split(".")[0] in capsys.readouterr().err


@pytest.mark.parametrize(
    ("scene", "name"),
    [("637f20cafde22ff8", "637f20cafde22ff8"), ("../a b", "a-b"), ("//", "scene")],
)
def test_a_page_is_named_after_its_scene_and_stays_in_its_folder(scene, name):
    assert file_name(scene) == name
