"""Weights to begin with: those of the package, of a folder, of a key."""

import dataclasses
import re

import numpy as np
import pytest
import torch

from infgen.config import ModelSettings, TokenSettings, VocabSettings
from infgen.errors import ConfigError
from infgen.model.network import Network
from infgen.pretrained import builtin_weights
from infgen.pretrained.card import CARD
from infgen.scene import Scene
from pipeline.engine.atomic import StoreError, write_json
from pipeline.engine.layout import Root
from pipeline.engine.stage import FinishedUnit
from pipeline.stages import vocabulary
from pipeline.storage.initial_weights import DESCRIPTION, WEIGHTS, find_initial_weights
from pipeline.storage.scenes import SCENES_SCHEMA
from pipeline.storage.weights import (
    copy_weights,
    load_network,
    load_vocabularies,
    read_description,
    save_network,
    state_dict_of,
)
from pipeline.storage.weights import vocabulary_fingerprint as fingerprint
from pipeline.storage.zarr_store import write_records

LARGEST_BYTES = 8 << 20


def quiet(done, total, note=""):
    """Nobody is told."""


@dataclasses.dataclass
class Files:
    """Inputs of ``build-vocab``, which reads units only."""

    files: list
    sources: list

    def units(self, name):
        return {"ingest": self.files}[name]

    def folder(self, name):
        raise AssertionError(name)

    key = folder

    def content(self, name, *names):
        raise AssertionError(name)


def test_nothing_is_found_where_nothing_is_named(tmp_path):
    assert find_initial_weights(tmp_path, "train.initial_weights", "") == []


def test_the_packages_own_weights_go_by_a_word(tmp_path):
    (source,) = find_initial_weights(tmp_path, "train.initial_weights", "builtin")

    assert source.url == str(builtin_weights())
    assert source.fingerprint == read_description(builtin_weights())["weights"]


def test_the_packages_weights_are_small_and_load():
    network = load_network(builtin_weights())

    files = {path.name: path.stat().st_size for path in builtin_weights().iterdir()}
    assert set(files) == {WEIGHTS, DESCRIPTION, CARD}
    assert sum(files.values()) <= LARGEST_BYTES
    assert network.settings.insertion_and_removal
    assert sum(p.numel() for p in network.parameters()) > 800_000


def test_the_start_of_a_key_is_enough_if_it_is_of_one_run_only(tmp_path):
    made = [Root(tmp_path).stage("train") / key for key in ("abcd01", "abcd02")]
    for folder in made:
        folder.mkdir(parents=True)
        write_json(folder / DESCRIPTION, {"weights": folder.name * 8})

    (source,) = find_initial_weights(tmp_path, "train.initial_weights", "abcd02")
    assert source.url == str(made[1])
    with pytest.raises(
        ConfigError, match=r"x.initial_weights is 'abcd', but several have it"
    ):
        find_initial_weights(tmp_path, "x.initial_weights", "abcd")
    with pytest.raises(ConfigError, match=r"expected 'builtin', a folder with"):
        find_initial_weights(tmp_path, "x.initial_weights", "ef")


@pytest.mark.parametrize("about", [{}, [], {"schema": "infgen.model/2"}])
def test_a_page_that_does_not_tell_of_weights_is_refused(tmp_path, about):
    write_json(tmp_path / DESCRIPTION, about)

    with pytest.raises(
        ConfigError, match=r"x.initial_weights: .*model.json lacks the entry 'weig"
    ):
        find_initial_weights(tmp_path, "x.initial_weights", str(tmp_path))


def test_a_network_of_another_size_is_told_what_is_different_and_where_to_find_it():
    small = ModelSettings(
        width=16, heads=2, map_blocks=1, motion_blocks=1, scene_blocks=1, fourier_bands=4
    )
    books = load_vocabularies(builtin_weights())
    network = Network(small, *books, TokenSettings())

    with pytest.raises(StoreError) as told:
        copy_weights(network, builtin_weights())

    message = str(told.value)
    assert re.search(r"for \S+, \S+, \S+ and \d+ more tensors; they were", message)
    assert "model.width=48 (not 16)" in message
    assert re.search(r", and \d+ more, all in its model.json", message)
    assert "--profile pretrained" in message
    assert len(message) < 1000


FEATURES = (
    *("density_features", "ego_features", "standing_features", "removal_features"),
    *("approach_features", "offset_token", "latent_rates", "last_move_head"),
    *("placement_features", "over_edge_head"),
)
WIDTHS = (
    *("cell_refinement_width", "agent_spacing_width"),
    *("clearance_width", "edge_clearance_width"),
)
ADDED = {**dict.fromkeys(FEATURES, True), **dict.fromkeys(WIDTHS, 8)}
NONE_ADDED = {**dict.fromkeys(FEATURES, False), **dict.fromkeys(WIDTHS, 0)}


def test_added_parts_may_be_missing_in_weights_to_begin_with(tmp_path):
    builtin = load_network(builtin_weights())
    vocabularies = builtin.motion_vocabulary(), builtin.map_vocabulary()
    without = dataclasses.replace(builtin.settings, **NONE_ADDED)
    plain = Network(without, *vocabularies, builtin.grid_settings)
    save_network(tmp_path, plain, state_dict_of(plain), step=0)
    every = dataclasses.replace(without, **ADDED)
    network = Network(every, *vocabularies, builtin.grid_settings)

    copy_weights(network, tmp_path)

    found, own = dict(network.named_parameters()), dict(plain.named_parameters())
    parts = tuple(network.added_parts())
    assert len(parts) == 18
    added = found.keys() - own.keys()
    assert added
    assert all(name.startswith(parts) for name in added)
    for name in found.keys() & own.keys():
        assert torch.equal(found[name], own[name]), name


def test_vocabularies_are_those_of_the_weights_and_measured_on_the_records(tmp_path, drive):
    settings = VocabSettings(initial_weights="builtin")
    files = []
    for split, speed_mps in (("training", 5.0), ("validation", 7.0)):
        path = tmp_path / f"{split}.tfrecord-0"
        path.mkdir()
        scenes = [drive(speed_mps=speed_mps)]
        write_records(path / "scenes-000.zarr", scenes, Scene, SCENES_SCHEMA, compress=True)
        files.append(FinishedUnit(path.name, "key", path, {"scenes": 1}))
    inputs = Files(files, vocabulary.reads(tmp_path, settings))
    units = []
    for unit in vocabulary.plan(inputs, settings):
        folder = tmp_path / "units" / unit.name
        folder.mkdir(parents=True)
        report = vocabulary.work(unit, folder, settings, quiet)
        units.append(FinishedUnit(unit.name, "key", folder, report))
    (tmp_path / "vocab").mkdir()
    report = vocabulary.finish(inputs, units, tmp_path / "vocab", settings, quiet)

    motion, roads = vocabulary.load_vocabularies(tmp_path / "vocab")
    assert fingerprint(motion, roads) == read_description(builtin_weights())["vocabulary"]
    np.testing.assert_array_equal(motion.path, load_vocabularies(builtin_weights())[0].path)
    assert report["real"]["vehicle"] == int(motion.real[0].sum())
    assert 0 <= report["error_m"]["vehicle"] < 0.2
