import dataclasses
from itertools import chain

import numpy as np
import polars as pl
import pytest
import torch

from infgen.config import RolloutSettings, TokenSettings
from infgen.model.network import Network
from infgen.scene import Scene
from pipeline.engine.stage import FinishedUnit
from pipeline.stages import rollout as stage
from pipeline.stages.calibration import Biases, write_found
from pipeline.stages.devices import DeviceError
from pipeline.storage.rollouts import read_rollouts
from pipeline.storage.scenes import SCENES_SCHEMA
from pipeline.storage.weights import save_network, state_dict_of
from pipeline.storage.zarr_store import write_records
from tests.pipeline.finished import TINY, Finished

SETTINGS = RolloutSettings(
    seconds=2.0, count=2, scenes_per_unit=2, batch_rollouts=3, max_agents=16
)


def no_progress(done, total, note=""):
    pass


@pytest.fixture
def inputs(tmp_path, weights, drive, crossing, parked):
    """One file of training, one of validation with five scenes; one cannot be played."""
    scenes = [drive(), crossing(), drive(now=3), parked(), crossing()]
    named = [
        dataclasses.replace(scene, scenario_id=f"scene {at}")
        for at, scene in enumerate(scenes)
    ]
    done = []
    for name, part in (
        ("training.tfrecord-0", named[:1]),
        ("validation.tfrecord-0", named),
    ):
        folder = tmp_path / name
        folder.mkdir()
        write_records(folder / "scenes-000.zarr", part, Scene, SCENES_SCHEMA, compress=True)
        done.append(FinishedUnit(name, f"key of {name}", folder, {"scenes": len(part)}))
    return Finished(done, weights)


def play(unit, folder, settings=SETTINGS):
    folder.mkdir()
    report = stage.STAGE.work(unit, folder, settings, no_progress)
    return report, list(read_rollouts(folder))


def test_the_split_is_cut_into_units_of_a_few_scenes(inputs):
    units = stage.STAGE.plan(inputs, SETTINGS)

    assert [unit.name for unit in units] == [
        f"validation.tfrecord-0-0000{first}" for first in (0, 2, 4)
    ]
    assert [unit.task["rows"] for unit in units] == [[0, 1], [2, 3], [4]]
    assert units[0].inputs == {
        "scenes": "key of validation.tfrecord-0",
        "weights": "content of train",
    }


@pytest.mark.parametrize(
    ("scenes", "most", "parts"),
    [(9, 8, [5, 4]), (17, 8, [6, 6, 5]), (8, 8, [8])],
)
def test_units_are_of_about_equal_work(inputs, scenes, most, parts):
    shard = FinishedUnit(
        "validation.tfrecord-1", "key", inputs.scenes[1].path, {"scenes": scenes}
    )
    settings = dataclasses.replace(SETTINGS, scenes_per_unit=most)

    units = stage.STAGE.plan(Finished([shard], inputs.weights), settings)

    found = [unit.task["rows"] for unit in units]
    assert [len(rows) for rows in found] == parts
    assert list(chain.from_iterable(found)) == list(range(scenes))


def test_the_pace_is_told_and_kept_apart_from_what_is_reproducible(inputs, tmp_path):
    (unit,) = stage.STAGE.plan(inputs, dataclasses.replace(SETTINGS, max_scenes=1))
    told, target = [], tmp_path / "out"
    target.mkdir()

    report = stage.STAGE.work(unit, target, SETTINGS, lambda *step: told.append(step))

    assert told[-1][:2] == (2.0, 2)
    assert [step[0] for step in told] == [0.5, 1.0, 1.5, 2.0]
    assert all(step[2].endswith(" rollouts/s") for step in told)
    assert report["run"]["rollouts_per_s"] > 0


def test_units_on_another_type_of_device_are_other_units(inputs, monkeypatch, tmp_path):
    settings = dataclasses.replace(SETTINGS, max_scenes=1, seconds=1.0)
    (here,) = stage.STAGE.plan(inputs, settings)
    monkeypatch.setattr(stage, "decide_device", lambda settings: "cuda")
    (there,) = stage.STAGE.plan(inputs, settings)

    assert (here.task["device"], there.task["device"]) == ("cpu", "cuda")
    assert dataclasses.replace(there, task={**there.task, "device": "cpu"}) == here
    with pytest.raises(DeviceError, match="has no CUDA device"):
        play(there, tmp_path / "there", settings)


def test_the_report_names_the_type_of_device_and_the_run_record_the_device(
    inputs, tmp_path
):
    settings = dataclasses.replace(SETTINGS, max_scenes=1, seconds=1.0, precision="bf16")
    (unit,) = stage.STAGE.plan(inputs, settings)

    report, _ = play(unit, tmp_path / "out", settings)

    threads = torch.get_num_threads()
    assert (report["device"], report["rules"]) == ("cpu", "none")
    assert report["run"]["device"] == f"CPU, {threads} thread{'s'[: threads - 1]}, bf16"


def test_the_calibrated_biases_are_added_to_those_of_the_settings(inputs, tmp_path):
    write_found(inputs.calibrated, Biases(add=0.75, leave=-0.5))
    settings = dataclasses.replace(SETTINGS, max_scenes=1, add_bias=1.0)

    (unit,) = stage.STAGE.plan(inputs, settings)
    report, _ = play(unit, tmp_path / "calibrated", settings)

    assert unit.task["biases"] == {"add": 0.75, "leave": -0.5}
    assert (report["add_bias"], report["remove_bias"]) == (1.75, -0.5)


def test_of_limited_scenes_those_far_apart_are_played(inputs, tmp_path):
    units = stage.STAGE.plan(inputs, dataclasses.replace(SETTINGS, max_scenes=3))

    assert [unit.name[-5:] for unit in units] == ["00000", "00003"]
    assert [unit.task["rows"] for unit in units] == [[0, 1], [3]]
    _, rollouts = play(units[1], tmp_path / "last")
    assert {rollout.scenario_id for rollout in rollouts} == {"scene 3"}


@pytest.mark.parametrize(
    ("nobody", "idle"),
    [
        (
            {"mode": "motion-only"},
            {
                **{"add_bias": 1.0, "remove_bias": 1.0, "heading_top_p": 0.5},
                "latent_rate_scale": 0.3,
            },
        ),
        ({"insert": False}, {"add_bias": 1.0, "max_insertions": 3, "position_top_k": 5}),
        ({"remove": False}, {"remove_bias": 1.0, "removal_radius_m": 70.0}),
    ],
)
def test_what_is_about_who_enters_or_leaves_decides_nothing_where_nobody_does(
    inputs, nobody, idle
):
    normalize = stage.STAGE.normalize
    plain, other = (
        dataclasses.replace(SETTINGS, max_scenes=1, **nobody, **more) for more in ({}, idle)
    )
    write_found(inputs.calibrated, Biases(add=0.75, leave=-0.5))

    (unit,) = stage.STAGE.plan(inputs, plain)

    assert (
        normalize({"rollout": other}) == normalize({"rollout": plain}) == {"rollout": plain}
    )
    assert unit.task["biases"] == {
        "add": 0.75 if plain.inserts else 0.0,
        "leave": -0.5 if plain.removes else 0.0,
    }
    everyone = {"rollout": dataclasses.replace(SETTINGS, **idle)}
    assert normalize(everyone) == everyone


def test_every_scene_of_a_unit_is_played_as_often_as_asked(inputs, tmp_path):
    unit = stage.STAGE.plan(inputs, SETTINGS)[0]

    report, rollouts = play(unit, tmp_path / "out")

    assert [(r.scenario_id, r.index) for r in rollouts] == [
        ("scene 0", 0),
        ("scene 0", 1),
        ("scene 1", 0),
        ("scene 1", 1),
    ]
    assert report["rollouts"] == 4
    assert all(rollout.num_steps == 11 + 20 for rollout in rollouts)
    index = pl.read_parquet(tmp_path / "out" / "index.parquet")
    assert index["agents"].to_list() == [len(rollout.id) for rollout in rollouts]


def test_a_scene_that_cannot_be_played_is_named_with_the_reason(inputs, tmp_path):
    unit = stage.STAGE.plan(inputs, SETTINGS)[1]

    report, rollouts = play(unit, tmp_path / "out")

    assert {rollout.scenario_id for rollout in rollouts} == {"scene 3"}
    assert len(report["refused"]) == 1
    assert report["refused"][0].startswith("scene 2: 1 steps hold no whole token")


def test_a_unit_is_the_same_bytes_each_time(inputs, tmp_path):
    unit = stage.STAGE.plan(inputs, SETTINGS)[0]

    play(unit, tmp_path / "one")
    play(unit, tmp_path / "two")

    one, two = (
        {
            p.relative_to(root): p.read_bytes()
            for p in sorted(root.rglob("*"))
            if p.is_file()
        }
        for root in (tmp_path / "one", tmp_path / "two")
    )
    assert one == two


def test_rollouts_are_the_same_bits_however_scenes_are_cut_into_units(inputs, tmp_path):
    settings = dataclasses.replace(SETTINGS, seconds=1.0, batch_rollouts=8)

    def played(scenes_per_unit):
        cut = dataclasses.replace(settings, scenes_per_unit=scenes_per_unit)
        folder = tmp_path / f"{scenes_per_unit} a unit"
        folder.mkdir()
        units = stage.STAGE.plan(inputs, cut)
        return [one for unit in units for one in play(unit, folder / unit.name, cut)[1]]

    for one, other in zip(played(1), played(5), strict=True):
        for field in dataclasses.fields(one):
            value, expected = getattr(one, field.name), getattr(other, field.name)
            np.testing.assert_array_equal(value, expected, err_msg=field.name)


def test_the_weights_fingerprint_is_in_every_rollout(inputs, tmp_path):
    unit = stage.STAGE.plan(inputs, SETTINGS)[0]

    _, rollouts = play(unit, tmp_path / "out")

    assert len({rollout.weights for rollout in rollouts}) == 1
    assert len(rollouts[0].weights) == 64


@pytest.mark.parametrize(("everyone", "agents"), [(False, 1), (True, 2)])
def test_agents_far_away_are_played_where_everyone_is_asked_for(
    tmp_path, weights, build_scene, everyone, agents
):
    path = np.zeros((2, 91, 3))
    path[1, :, 0] = 400.0
    folder = tmp_path / "validation.tfrecord-0"
    folder.mkdir()
    scene = build_scene(path, [0, 0])
    write_records(folder / "scenes-000.zarr", [scene], Scene, SCENES_SCHEMA, compress=True)
    inputs = Finished([FinishedUnit(folder.name, "key", folder, {"scenes": 1})], weights)
    settings = dataclasses.replace(
        SETTINGS, all_agents=everyone, insert=False, remove=False
    )

    _, rollouts = play(stage.STAGE.plan(inputs, settings)[0], tmp_path / "out", settings)

    assert len(rollouts[0].id) == agents


@pytest.mark.parametrize(
    ("model", "simulates"),
    [({}, "motion, entries, exits"), ({"insertion_and_removal": False}, "motion only")],
)
def test_the_report_says_what_the_weights_play(
    inputs, tmp_path, metre_moves, bent_roads, model, simulates
):
    sizes = dataclasses.replace(TINY, **model)
    network = Network(sizes, metre_moves, bent_roads, TokenSettings())
    save_network(inputs.folder("train"), network, state_dict_of(network), step=7)
    settings = dataclasses.replace(SETTINGS, max_scenes=1, seconds=1.0)
    (unit,) = stage.STAGE.plan(inputs, settings)

    report, rollouts = play(unit, tmp_path / "out", settings)

    assert report["simulates"] == simulates
    if model:
        assert all(rollout.logged.all() for rollout in rollouts)


def test_the_stage_sums_up_its_units(inputs, tmp_path):
    done = []
    for unit in stage.STAGE.plan(inputs, SETTINGS):
        report, _ = play(unit, tmp_path / unit.name)
        done.append(FinishedUnit(unit.name, "key", tmp_path / unit.name, report))
    target = tmp_path / "stage"
    target.mkdir()

    report = stage.STAGE.finish(inputs, done, target, SETTINGS, no_progress)

    assert report["rollouts"] == 8
    assert report["device"] == "cpu"
    assert report["simulates"] == "motion, entries, exits"
    assert len(report["refused"]) == 1
    assert len(pl.read_parquet(target / "index.parquet")) == 8
