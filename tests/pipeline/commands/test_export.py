"""``infgen export``: our rollouts in the formats of others, from the command line on."""

import gzip
import json
import os
import tarfile
from dataclasses import replace
from pathlib import Path
from threading import Timer

import numpy as np
import polars as pl
import pytest

from cli import main
from infgen.config import IngestSettings
from infgen.errors import ConfigError
from infgen.exports.scenarionet import with_arrays
from infgen.metrics.wosac.rollouts import RolloutsError
from infgen.metrics.wosac.submission import read_submission
from infgen.rollout.rollout import Rollout
from infgen.scene import AgentType, Scene, Signals, SignalState
from infgen.sources.tfrecord import iter_records
from infgen.sources.womd import decode_scene
from infgen.sources.womd_write import encode_scenario, write_tfrecord
from pipeline.commands.export import FORMATS, export
from pipeline.commands.export_job import ExportError, Order
from pipeline.commands.export_wosac import read_description
from pipeline.commands.wosac import score_files
from pipeline.engine.atomic import StoreError, write_json
from pipeline.engine.layout import Root
from pipeline.engine.locks import LOCK_TIMEOUT_S, LockedError, locked
from pipeline.engine.stage import Unit
from pipeline.stages import ingest
from pipeline.storage.rollouts import ROLLOUTS_SCHEMA, read_rollouts
from pipeline.storage.scene_lookup import open_scene_lookup
from pipeline.storage.sources.fingerprints import fingerprint as file_identity
from pipeline.storage.zarr_store import write_records
from tests.exports.replays import replay, with_newcomer, without
from tests.exports.submission_proto import Submission
from tests.exports.test_wosac import ABOUT
from tests.metrics.golden import GOLDEN, needs_goldens

SCENES = 3
YAML = """\
account_name: me@example.org
unique_method_name: InfGen
authors: [Ada, Bo]
acknowledge_complies_with_closed_loop_requirement: true
num_model_parameters: 11M
"""


def silent(done, total, note=""):
    pass


@pytest.fixture(scope="module")
def logs(source, tmp_path_factory):
    target = tmp_path_factory.mktemp("logs") / "unit"
    ingest.work(
        Unit(source.name, {"source": file_identity(source)}, {"url": str(source)}),
        target,
        IngestSettings(),
        silent,
    )
    return target


def keep(folder: Path, rollouts) -> Path:
    """Write rollouts as a unit of our store."""
    folder.mkdir(parents=True)
    path = folder / "rollouts-000.zarr"
    write_records(path, rollouts, Rollout, ROLLOUTS_SCHEMA, compress=True)
    index = {
        "scenario_id": [one.scenario_id for one in rollouts],
        "rollout": [one.index for one in rollouts],
    }
    pl.DataFrame(
        index, schema={"scenario_id": pl.String, "rollout": pl.Int64}
    ).write_parquet(folder / "index.parquet")
    return folder


def stage(root: Path, *units) -> Path:
    """A made stage of several units, as ``latest`` shows it."""
    for at, rollouts in enumerate(units):
        keep(root / "units" / f"{at:016d}", rollouts)
    (root / "made").mkdir()
    about = {
        "files": {},
        "units": [
            {"name": f"u{at}", "key": f"{at:016d}" + "0" * 48} for at in range(len(units))
        ],
        "report": {"refused": ["odd: no agent is there"]},
    }
    write_json(root / "made" / "manifest.json", about)
    return root / "made"


def many(scene: Scene, count: int = 32) -> list[Rollout]:
    return [replay(scene, at, 0.05 * at) for at in range(count)]


@pytest.fixture(scope="module")
def played(scenes, tmp_path_factory):
    """32 rollouts of each scene: two scenes in one unit, the third in another."""
    root = tmp_path_factory.mktemp("played")
    return stage(root, [*many(scenes[2]), *many(scenes[0])], many(scenes[1]))


@pytest.fixture(scope="module")
def few(scenes, tmp_path_factory):
    """Two rollouts of each scene, one agent inserted."""
    rollouts = [with_newcomer(replay(s, at), 40) for s in scenes for at in range(2)]
    return keep(tmp_path_factory.mktemp("few") / "unit", rollouts)


@pytest.fixture
def order(played, logs, tmp_path):
    out = tmp_path / "submission.tar.gz"
    return Order(
        "wosac", played, open_scene_lookup([str(logs)]), out, ABOUT, scenes_per_shard=2
    )


@pytest.fixture
def infgen(capsys):
    def call(*words):
        with pytest.raises(SystemExit) as left:
            main(["export", *map(str, words)])
        out, err = capsys.readouterr()
        return left.value.code or 0, out, err

    return call


def members(path: Path) -> dict[str, bytes]:
    with tarfile.open(path) as archive:
        return {each.name: archive.extractfile(each).read() for each in archive}


def test_a_submission_is_an_archive_of_numbered_shards_with_all_fields(order, scenes):
    found = export(order)

    shards = members(order.out)
    assert list(shards) == [f"submission.binproto-0000{at}-of-00002" for at in range(2)]
    messages = [Submission.FromString(data) for data in shards.values()]
    assert [len(one.scenario_rollouts) for one in messages] == [2, 1]
    ids = [one.scenario_id for each in messages for one in each.scenario_rollouts]
    assert ids == [scenes[at].scenario_id for at in (2, 0, 1)]
    assert {one.account_name for one in messages} == {"me@example.org"}
    assert (found.scenes, found.rollouts, found.files) == (3, 96, 2)
    assert found.bytes == order.out.stat().st_size
    assert found.not_simulated == ["odd: no agent is there"]
    assert not order.partial.exists()


def test_our_reader_reads_it_back_and_it_scores_as_the_store_does(order, logs, played):
    export(order)

    ours, theirs = (score_files([str(logs)], x, "wosac-2025") for x in (played, order.out))

    assert len(ours.scores) == SCENES
    assert theirs.refused == []
    assert theirs.scores == ours.scores


def test_a_submission_is_the_same_bytes_each_time(order, tmp_path):
    export(order)
    export(replace(order, out=tmp_path / "again.tar.gz"))

    assert (tmp_path / "again.tar.gz").read_bytes() == order.out.read_bytes()
    assert gzip.decompress(order.out.read_bytes()).startswith(b"submission.binproto-00000")
    with tarfile.open(order.out) as archive:
        facts = {(m.mtime, m.uid, m.gid, m.uname, m.mode) for m in archive}
    assert facts == {(0, 0, 0, "", 0o644)}


class _Stop(Exception):  # noqa: N818
    """The run is killed here."""


def killed_after(count: int):
    """A listener that raises once so many scenes are done."""

    def tell(event):
        if event["event"] == "progress" and event["done"] >= count:
            raise _Stop

    return tell


def test_a_killed_submission_goes_on_from_its_last_shard(order, tmp_path):
    whole = replace(order, out=tmp_path / "whole.tar.gz")
    export(whole)
    with pytest.raises(_Stop):
        export(order, killed_after(3))
    assert not order.out.exists()

    found = export(order)

    assert found.before == 2
    assert order.out.read_bytes() == whole.out.read_bytes()


def test_another_order_does_not_go_on_from_what_a_killed_one_left(order):
    with pytest.raises(_Stop):
        export(order, killed_after(3))

    found = export(replace(order, about=replace(ABOUT, unique_method_name="Other")))

    assert found.before == 0
    (shard, _) = members(order.out).values()
    assert Submission.FromString(shard).unique_method_name == "Other"


def test_too_few_rollouts_are_refused_before_anything_is_written(order, few):
    with pytest.raises(RolloutsError, match="has 2 rollouts, and 2 more scenes too few"):
        export(replace(order, rollouts=few))

    assert not order.partial.exists()


def test_a_wrong_scene_is_refused_by_name(order, scenes, tmp_path):
    rollouts = many(scenes[0])
    gone = int(rollouts[0].id[rollouts[0].ego - 1])
    rollouts[7] = without(rollouts[7], gone)
    wrong = replace(order, rollouts=keep(tmp_path / "wrong", rollouts))

    with pytest.raises(
        RolloutsError, match=f"scene {scenes[0].scenario_id}: 1 of .*{gone}"
    ):
        export(wrong)
    assert not order.out.exists()


def test_rollouts_beyond_32_are_left_out_and_counted(order, scenes, tmp_path):
    rollouts = keep(tmp_path / "more", many(scenes[0], 35))

    found = export(replace(order, rollouts=rollouts))

    assert (found.rollouts, found.unused) == (32, 3)
    assert len(next(iter(read_submission(order.out))).x_m) == 32


def test_agents_that_no_model_plays_are_there_and_told_of(scenes, tmp_path):
    scene = scenes[0]
    shown = np.flatnonzero(scene.tracks.valid[:, scene.now])
    row = int(np.setdiff1d(shown, [scene.ego, *scene.predict_row])[0])
    kind = scene.tracks.agent_type.copy()
    kind[row] = AgentType.OTHER
    scene = replace(scene, tracks=replace(scene.tracks, agent_type=kind))
    write_tfrecord(tmp_path / "logs.tfrecord", [encode_scenario(scene)])
    rollouts = [without(one, int(scene.tracks.id[row])) for one in many(scene)]
    order = Order(
        to="wosac",
        rollouts=keep(tmp_path / "unit", rollouts),
        logs=open_scene_lookup([str(tmp_path / "logs.tfrecord")]),
        out=tmp_path / "s.tar.gz",
        about=ABOUT,
    )

    found = export(order)

    assert found.filled == {scene.scenario_id: 1}
    official = score_files([str(tmp_path / "logs.tfrecord")], order.out, "wosac-2025")
    assert official.refused == []


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"to": "wosacs"}, "no format 'wosacs'; did you mean wosac?"),
        ({"to": "csv"}, f"there is {', '.join(FORMATS)}"),
        ({"about": None}, "a submission tells who submits what"),
        (
            {"about": replace(ABOUT, num_model_parameters="")},
            "a submission tells num_model_parameters",
        ),
        ({"out": Path("nowhere/submission.zip")}, "expected a name ending in .tar.gz"),
        ({"out": Path(__file__)}, "exists; remove it"),
        ({"rollouts": Path("nowhere")}, "holds no rollouts"),
    ],
)
def test_wrong_orders_are_refused(order, change, reason):
    with pytest.raises(ConfigError) as refused:
        export(replace(order, **change))

    assert reason in str(refused.value)


@pytest.mark.parametrize("to", ["wosac", "gpudrive"])
def test_a_unit_that_lost_rollouts_is_damaged_and_nothing_is_exported(
    order, scenes, tmp_path, to
):
    unit = keep(tmp_path / "unit", many(scenes[0]))
    (unit / "rollouts-000.zarr").unlink()
    kept = many(scenes[0])[:31]
    write_records(unit / "rollouts-001.zarr", kept, Rollout, ROLLOUTS_SCHEMA, compress=True)

    with pytest.raises(StoreError, match=f"rollouts of scene {scenes[0].scenario_id}"):
        export(replace(order, to=to, rollouts=unit))
    assert not order.out.exists()


def test_an_id_that_cannot_name_a_file_is_refused(order, scenes, tmp_path):
    evil = [replace(one, scenario_id="../evil") for one in many(scenes[0])]

    with pytest.raises(ExportError, match=r"'\.\./evil' cannot name a file"):
        export(replace(order, rollouts=keep(tmp_path / "evil", evil)))


def test_parquet_has_a_partition_per_scene_and_all_rows(few, logs, scenes, tmp_path):
    order = Order("parquet", few, open_scene_lookup([str(logs)]), tmp_path / "table")

    found = export(order)

    names = {str(p.relative_to(order.out)) for p in order.out.rglob("*") if p.is_file()}
    assert names == {f"scenario_id={s.scenario_id}/rollouts.parquet" for s in scenes}
    table = pl.scan_parquet(order.out, hive_partitioning=True).collect()
    rollouts = list(read_rollouts(few))
    assert len(table) == sum(int(one.valid.sum()) for one in rollouts)
    one = rollouts[3]
    rows = table.filter(
        (pl.col("scenario_id") == one.scenario_id) & (pl.col("rollout") == one.index)
    )
    step = rows.filter((pl.col("agent") == int(one.id[0])) & (pl.col("step") == 50))
    expected = one.xyz_m[0, 50].astype(float) + one.origin_xyz_m
    assert step.select("x_m", "y_m", "z_m").row(0) == pytest.approx(tuple(expected))
    assert (found.scenes, found.rollouts, found.files) == (3, 6, 3)


@pytest.mark.parametrize("to", ["gpudrive", "scenarionet"])
def test_there_is_a_file_per_scene_and_rollout(few, logs, scenes, tmp_path, to):
    order = Order(to, few, open_scene_lookup([str(logs)]), tmp_path / "out")

    found = export(order)

    start = {"gpudrive": "tfrecord-", "scenarionet": "sd_infgen_"}[to]
    assert sorted(path.name for path in order.out.iterdir()) == sorted(
        f"{start}{scene.scenario_id}_{at:03d}.json" for scene in scenes for at in range(2)
    )
    assert found.files == 6
    for path in order.out.iterdir():
        text = json.loads(path.read_text())
        if to == "gpudrive":
            assert len(text["name"]) <= 31
            assert text["roads"]
        else:
            assert with_arrays(text)["metadata"]["ts"].shape == (text["length"],)


@pytest.mark.parametrize("to", ["gpudrive", "scenarionet", "parquet"])
def test_a_killed_folder_goes_on_scene_by_scene_to_the_same_bytes(few, logs, tmp_path, to):
    def files(folder):
        return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*.*")}

    order = Order(to, few, open_scene_lookup([str(logs)]), tmp_path / "a")
    with pytest.raises(_Stop):
        export(order, killed_after(2))
    assert not order.out.exists()

    found = export(order)

    assert found.before == 2
    export(replace(order, out=tmp_path / "b"))
    assert files(tmp_path / "a") == files(tmp_path / "b")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


@pytest.mark.parametrize(
    ("played", "later"), [("log", "GO"), ("now", "STOP"), (None, "STOP")]
)
def test_lights_are_those_that_were_played(scenes, tmp_path, played, later):
    """As the manifest of the rollouts says; old ones do not."""
    lane = int(scenes[0].road_map.feature_id[0])
    states = [SignalState.STOP] * 30 + [SignalState.GO] * 61
    lights = Signals(
        step=np.arange(91, dtype=np.int16),
        lane_id=np.full(91, lane),
        state=np.array(states, np.int8),
        stop_xyz_m=np.zeros((91, 3), np.float32),
    )
    scene = replace(scenes[0], signals=lights)
    write_tfrecord(tmp_path / "logs.tfrecord", [encode_scenario(scene)])
    rollouts = keep(tmp_path / "unit", [replay(scene)])
    settings = {"rollout": {"signals": played} if played else {}}
    write_json(rollouts / "manifest.json", {"files": {}, "settings": settings})
    logs = open_scene_lookup([str(tmp_path / "logs.tfrecord")])

    for to in ("gpudrive", "scenarionet"):
        export(Order(to, rollouts, logs, tmp_path / to))

    (path,) = (tmp_path / "gpudrive").iterdir()
    shown = json.loads(path.read_text())["tl_states"][str(lane)]["state"]
    assert (shown[29], shown[30], shown[90]) == ("stop", later.lower(), later.lower())
    (path,) = (tmp_path / "scenarionet").iterdir()
    light = json.loads(path.read_text())["dynamic_map_states"][str(lane)]
    assert light["state"]["object_state"][90] == f"LANE_STATE_{later}"


@pytest.mark.slow
@pytest.mark.parametrize("to", FORMATS)
def test_one_process_at_a_time_writes_an_export(order, tmp_path, to):
    """A second one is refused, and the first writes what it would have written alone."""
    alone = replace(order, to=to, out=tmp_path / "alone.tar.gz")
    export(alone)
    twice, refused = replace(alone, out=tmp_path / "twice.tar.gz"), []

    def tell(event):
        if event["event"] == "progress" and event["done"] == 1:
            with pytest.raises(LockedError) as error:
                export(twice)
            refused.append(str(error.value))

    found = export(twice, tell)

    assert len(refused) == 1
    assert "is being made by process" in refused[0]
    assert f"({twice.lock})" in refused[0]
    assert (found.scenes, found.before) == (SCENES, 0)
    written = [
        {path.relative_to(out): path.read_bytes() for path in out.rglob("*.*")}
        if out.is_dir()
        else out.read_bytes()
        for out in (alone.out, twice.out)
    ]
    assert written[0] == written[1]
    assert {path.name for path in tmp_path.iterdir()} == {"alone.tar.gz", "twice.tar.gz"}


def test_who_waited_for_another_process_finds_what_it_wrote(order):
    """It is refused like any other that comes later, and writes nothing over it."""
    holding = locked(order.lock)
    holding.__enter__()

    def finish():
        order.out.write_bytes(b"whole")
        holding.__exit__(None, None, None)

    Timer(LOCK_TIMEOUT_S / 3, finish).start()

    with pytest.raises(ConfigError, match="exists; remove it"):
        export(order)
    assert order.out.read_bytes() == b"whole"
    assert not order.partial.exists()


def test_the_command_says_in_one_line_who_is_at_it(infgen, few, logs, tmp_path):
    words = ["--to", "parquet", few, "--records", logs, "--root", tmp_path]

    with locked(tmp_path / "table.lock"):
        code, _, err = infgen(*words, "--out", tmp_path / "table")

    assert (code, err.count("\n")) == (75, 1)
    assert f"is being made by process {os.getpid()} on " in err
    assert not (tmp_path / "table").exists()


def test_the_command_exports_the_latest_rollouts_of_a_root(
    infgen, few, logs, tmp_path, scenes
):
    root = tmp_path / "R"
    (root / "latest").mkdir(parents=True)
    (root / "latest" / "rollout").symlink_to(few)
    (root / "latest" / "ingest").symlink_to(logs)

    code, out, _ = infgen(
        "--to", "parquet", "--root", root, "--out", tmp_path / "o", "--json"
    )

    found = json.loads(out)
    assert code == 0
    assert (found["format"], found["scenes"], found["filled"]) == ("parquet", 3, {})
    assert len(list((tmp_path / "o").iterdir())) == SCENES


def test_the_command_writes_a_submission_and_prints_what_it_is(
    infgen, played, source, tmp_path
):
    (tmp_path / "about.yaml").write_text(YAML)
    words = ["--to", "wosac", played, "--records", source, "--root", tmp_path]
    words += ["--about", tmp_path / "about.yaml", "--out", tmp_path / "s.tar.gz"]

    code, out, err = infgen(*words)

    assert code == 0
    assert "rollouts" in out
    assert "96" in out
    assert "not simulated, so not in it: odd: no agent is there" in err
    code, _, err = infgen(*words)
    assert code == 2
    assert "exists; remove it" in err


def test_the_command_says_in_one_line_what_is_wrong(infgen, few, source, tmp_path):
    (tmp_path / "about.yaml").write_text(YAML)
    words = ["--to", "wosac", few, "--records", source, "--root", tmp_path]

    code, _, err = infgen(*words, "--out", tmp_path / "s.tar.gz")
    assert (code, err.count("\n")) == (2, 1)
    code, _, err = infgen(
        *words, "--out", tmp_path / "s.tar.gz", "--about", tmp_path / "about.yaml"
    )
    assert code == 1
    assert "has 2 rollouts, and 2 more scenes too few; expected 32" in err


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (YAML.replace("account_name", "acount_name"), "did you mean 'account_name'"),
        (
            YAML.replace("[Ada, Bo]", "Ada"),
            "about.yaml:3: about.authors is 'Ada'; expected a valid tuple",
        ),
        ("authors: [Ada]", "account_name, unique_method_name, acknowledge"),
        (YAML.replace(": true", ": maybe"), "is 'maybe'; expected a valid boolean"),
        (YAML + "authors: [Cy]\n", "is given twice"),
    ],
)
def test_a_wrong_file_of_who_submits_what_is_explained(tmp_path, text, reason):
    path = tmp_path / "about.yaml"
    path.write_text(text)

    with pytest.raises(ConfigError) as refused:
        read_description(path, Root(tmp_path))

    assert reason in str(refused.value)


def test_a_missing_file_of_who_submits_what_says_what_is_expected(tmp_path):
    with pytest.raises(ConfigError, match="no such file; expected YAML with account_name"):
        read_description(tmp_path / "about.yaml", Root(tmp_path))


def test_the_number_of_parameters_is_that_of_the_roots_network(tmp_path):
    folder = tmp_path / "store" / "train" / "k"
    folder.mkdir(parents=True)
    write_json(folder / "manifest.json", {"report": {"parameters": 999_195}, "files": {}})
    (tmp_path / "latest").mkdir()
    (tmp_path / "latest" / "train").symlink_to(folder)
    path = tmp_path / "about.yaml"
    path.write_text(YAML.replace("num_model_parameters: 11M\n", ""))

    assert read_description(path, Root(tmp_path)).num_model_parameters == "999K"
    path.write_text(YAML)
    assert read_description(path, Root(tmp_path)).num_model_parameters == "11M"


@needs_goldens
def test_a_real_scene_scores_the_same_through_a_submission(tmp_path):
    record = next(GOLDEN.glob("*/scenario.tfrecord"))
    scene = decode_scene(next(iter_records(str(record))).data)
    rollouts = keep(tmp_path / "unit", many(scene))
    logs = open_scene_lookup([str(record)])
    order = Order("wosac", rollouts, logs, tmp_path / "s.tar.gz", ABOUT)

    export(order)

    ours, theirs = (
        score_files([str(record)], path, "wosac-2025") for path in (rollouts, order.out)
    )
    assert list(ours.scores) == [scene.scenario_id]
    assert theirs.scores == ours.scores
