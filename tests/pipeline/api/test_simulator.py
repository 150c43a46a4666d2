"""The facade simulates what the command line simulates, to the bit."""

import shutil
from dataclasses import fields, replace
from itertools import chain
from pathlib import Path

import numpy as np
import pytest

import infgen
from cli import main
from infgen.config import RolloutSettings
from infgen.errors import ConfigError
from infgen.pretrained import builtin_weights
from infgen.scene import Scene
from pipeline.engine.stage import FinishedUnit
from pipeline.stages import rollout as stage
from pipeline.stages.calibration import Biases, write_found
from pipeline.storage.rollouts import read_rollouts
from pipeline.storage.scenes import SCENES_SCHEMA
from pipeline.storage.zarr_store import write_records
from tests.pipeline.finished import Finished

SHORT = RolloutSettings(seconds=1.0, count=2, scenes_per_unit=2, seed=7)


def assert_equal(rollouts, others):
    for one, other in zip(rollouts, others, strict=True):
        for field in fields(one):
            value, expected = getattr(one, field.name), getattr(other, field.name)
            np.testing.assert_array_equal(
                value, expected, strict=isinstance(value, np.ndarray), err_msg=field.name
            )


def infgen_command(*words: str) -> None:
    with pytest.raises(SystemExit) as left:
        main(list(words))
    assert not left.value.code


@pytest.mark.parametrize(
    ("count", "batch_rollouts"),
    [(1, 32), (3, 32), (5, 2)],
    ids=["one", "one batch", "two batches and the rest"],
)
def test_rollouts_are_those_of_the_stage(builtin, weights, tmp_path, count, batch_rollouts):
    scenes, folder = list(builtin[3:6]), tmp_path / "validation.tfrecord-0"
    folder.mkdir()
    write_records(folder / "scenes-000.zarr", scenes, Scene, SCENES_SCHEMA, compress=True)
    done = FinishedUnit(folder.name, "key", folder, {"scenes": len(scenes)})
    settings = replace(SHORT, count=count, batch_rollouts=batch_rollouts)
    sim = infgen.load(
        weights,
        **{"seconds": 1.0, "scenes_per_unit": 2, "seed": 7},
        **{"count": count, "batch_rollouts": batch_rollouts},
    )
    assert sim.settings == settings

    made = []
    for unit in stage.STAGE.plan(Finished([done], weights), settings):
        target = tmp_path / unit.name
        target.mkdir()
        stage.STAGE.work(unit, target, settings, lambda *_: None)
        made.append(list(read_rollouts(target)))

    assert [len(rollouts) for rollouts in made] == [2 * count, count]
    assert_equal(chain(*map(sim.rollout, scenes)), chain(*made))


def test_seconds_count_and_seed_go_over_the_settings(scene, weights):
    sim = infgen.load(weights, seconds=1.0, count=2)

    usual = sim.rollout(scene)
    assert len(usual) == 2
    assert usual[0].num_steps == scene.now + 1 + 10
    other = sim.rollout(scene, seconds=0.5, count=1, seed=3)
    assert (len(other), other[0].num_steps, other[0].seed) == (1, scene.now + 1 + 5, 3)
    assert other.settings == replace(sim.settings, seconds=0.5, count=1, seed=3)


def test_nothing_after_now_is_looked_at(scene, weights):
    sim = infgen.load(weights, seconds=1.0, count=1)
    tracks = scene.tracks
    later = np.arange(tracks.num_steps) > scene.now
    blind = replace(scene, tracks=replace(tracks, valid=tracks.valid & ~later))

    assert_equal(sim.rollout(scene), sim.rollout(blind))


def test_the_weights_of_the_package_have_the_settings_of_their_profile():
    sim = infgen.load("towns")

    assert sim.folder == builtin_weights().resolve()
    assert (sim.settings.motion_top_p, sim.settings.rules) == (0.9, "none")
    assert infgen.load(builtin_weights()).settings == sim.settings
    assert infgen.load(motion_top_p=0.8).settings == replace(sim.settings, motion_top_p=0.8)


def test_rules_are_those_of_the_settings_unless_a_call_names_others(scene, weights):
    sim = infgen.load(weights, seconds=1.0, count=1)
    safe = infgen.load(weights, seconds=1.0, count=1, rules="safe", max_stall_s=30.0)

    assert sim.rollout(scene).settings.rules_in_words == "none"
    assert sim.rollout(scene, rules="safe").settings == replace(sim.settings, rules="safe")
    assert safe.rollout(scene).settings.rules_in_words == "safe, max_stall_s=30"
    assert safe.rollout(scene, rules="none").settings == sim.settings
    session = sim.session(scene, rules="safe")
    session.step()
    assert session.rollouts().settings == replace(sim.settings, rules="safe")
    with pytest.raises(ConfigError, match=r"rules is 'all'; expected 'none' or 'safe'"):
        infgen.load(weights, rules="all")
    with pytest.raises(ConfigError, match=r"max_stall_s is 30.0, but rules=none has no"):
        infgen.load(weights, max_stall_s=30.0)


def test_what_does_not_exist_is_told_with_the_way_out(tmp_path):
    with pytest.raises(ConfigError, match="no setting 'motion_topp'; did you mean"):
        infgen.load(motion_topp=0.8)
    with pytest.raises(ConfigError, match=r"rollout\.count is 0; .*greater than"):
        infgen.load(count=0)
    with pytest.raises(ConfigError, match="no weights 'nowhere'; expected 'towns'"):
        infgen.load("nowhere")
    with pytest.raises(ConfigError, match="weights is 'ab', but there is no such"):
        infgen.load("ab", root=tmp_path)
    (tmp_path / "store").mkdir()
    with pytest.raises(ConfigError, match="holds no trained weights; `infgen train"):
        infgen.load(tmp_path)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """A root of the command line, simulated with the weights of the package."""
    root = tmp_path_factory.mktemp("root") / "root"
    words = [
        "seconds=2",
        "count=2",
        "max_scenes=2",
        "scenes_per_unit=2",
        "remove_bias=-0.5",
    ]
    chosen = [part for word in words for part in ("-s", f"rollout.{word}")]
    records = ["--records", "builtin", "--profile", "pretrained"]
    infgen_command(
        "rollout",
        "--root",
        str(root),
        *records,
        "-s",
        "ingest.max_scenes_per_file=2",
        *chosen,
    )
    return root


@pytest.mark.slow
def test_rollouts_are_those_of_the_command(root, builtin):
    by_root, by_name = infgen.load(root), infgen.load("towns", remove_bias=-0.5)
    for scenario_id in infgen.open_scenes(root, split="validation").scenario_ids:
        made = infgen.open_rollouts(root, scene=scenario_id)

        assert made.settings == by_root.settings
        assert_equal(by_root.rollout(made.scene), made)
        again = by_name.rollout(builtin[scenario_id], seconds=2.0, count=2)
        assert_equal(again, made)


@pytest.mark.slow
def test_weights_are_found_by_root_folder_and_key(root, tmp_path):
    sim = infgen.load(root)

    key = sim.folder.name
    assert infgen.load(root / "latest/train") == sim
    assert infgen.load(key[:6], root=root) == sim
    assert infgen.load(sim.folder, root=root) == sim
    elsewhere = shutil.copytree(sim.folder, tmp_path / "weights")
    assert infgen.load(elsewhere).settings == RolloutSettings()
    assert infgen.load(elsewhere).weights == sim.weights


@pytest.mark.slow
def test_calibrated_biases_are_added_where_their_decision_is_taken(root, tmp_path):
    copy = shutil.copytree(root, tmp_path / "root", symlinks=True)
    write_found((copy / "latest/calibrate").resolve(), Biases(add=0.25, leave=0.5))

    settings = infgen.load(copy).settings

    assert (settings.add_bias, settings.remove_bias) == pytest.approx((0.25, 0.0))


@pytest.mark.slow
def test_weights_without_rollouts_have_the_settings_of_the_last_request(root, tmp_path):
    copy = shutil.copytree(root, tmp_path / "root", symlinks=True)
    (copy / "latest/rollout").unlink()

    assert infgen.load(copy).settings == infgen.load(root).settings
