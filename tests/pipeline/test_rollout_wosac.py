"""From a real log to a scored submission, by way of rollouts that a network played."""

import numpy as np
import pytest
import torch

from infgen.config import IngestSettings, ModelSettings, RolloutSettings, TokenSettings
from infgen.metrics.wosac.submission import read_submission
from infgen.model.network import Network
from infgen.sources.tfrecord import iter_records
from infgen.sources.womd import decode_scene
from pipeline.commands.export import export
from pipeline.commands.export_job import Order
from pipeline.commands.wosac import score_files
from pipeline.engine.stage import Unit
from pipeline.stages import ingest
from pipeline.stages.rollout import STAGE
from pipeline.storage.rollouts import read_rollouts
from pipeline.storage.scene_lookup import open_scene_lookup
from pipeline.storage.sources.fingerprints import fingerprint as file_identity
from pipeline.storage.weights import save_network, state_dict_of
from tests.exports.test_wosac import ABOUT
from tests.metrics.golden import GOLDEN, needs_goldens

TINY = ModelSettings(
    width=16, heads=2, map_blocks=1, motion_blocks=1, scene_blocks=1, fourier_bands=4
)
pytestmark = [needs_goldens, pytest.mark.slow]


@pytest.fixture(scope="module")
def record():
    """The smallest of the real records."""
    records = GOLDEN.glob("*/scenario.tfrecord")
    return min(records, key=lambda path: path.stat().st_size)


@pytest.fixture(scope="module")
def played(record, metre_moves, bent_roads, tmp_path_factory, quiet):
    """A unit of rollouts of it, played by Waymo's protocol with random weights."""
    root = tmp_path_factory.mktemp("played")
    scenes, weights, target = root / "validation", root / "train", root / "rollouts"
    ingest.work(
        Unit("v", {"source": file_identity(record)}, {"url": str(record)}),
        scenes,
        IngestSettings(),
        quiet,
    )
    torch.manual_seed(0)
    network = Network(TINY, metre_moves, bent_roads, TokenSettings())
    for folder in (weights, target):
        folder.mkdir()
    save_network(weights, network, state_dict_of(network), step=0)
    paths = {"scenes": str(scenes), "weights": str(weights)}
    task = {**paths, "biases": {}, "rows": [0], "device": "cpu"}
    unit = Unit("v-00000", {"weights": "random"}, task)
    report = STAGE.work(
        unit, target, RolloutSettings(mode="wosac", batch_rollouts=16), quiet
    )
    assert (report["rollouts"], report["inserted"], report["left"]) == (32, 0, 0)
    return target


@pytest.fixture(scope="module")
def exported(record, played, tmp_path_factory):
    out = tmp_path_factory.mktemp("exported") / "submission.tar.gz"
    export(Order("wosac", played, open_scene_lookup([str(record)]), out, ABOUT))
    return out


def test_everyone_there_at_now_is_played_for_eight_seconds(record, played):
    scene = decode_scene(next(iter_records(str(record))).data)
    there = scene.tracks.id[scene.tracks.valid[:, scene.now]]

    for rollout in read_rollouts(played):
        assert rollout.num_steps == 11 + 80
        assert set(there) <= set(rollout.id[rollout.valid[:, 10]])
        assert rollout.valid[np.isin(rollout.id, there), 10:].all()


def test_a_submission_holds_what_was_played(played, exported):
    (sent,) = read_submission(exported)
    stored = list(read_rollouts(played))

    assert len(stored) == 32
    assert sent.scenario_id == stored[0].scenario_id
    order = np.argsort(sent.object_id)
    sent_m = np.stack([sent.x_m, sent.y_m, sent.z_m], axis=-1)
    for at, rollout in enumerate(stored):
        row = order[np.searchsorted(sent.object_id[order], rollout.id)]
        np.testing.assert_array_equal(sent.object_id[row], rollout.id)
        xyz_m = rollout.xyz_m[:, 11:] + rollout.origin_xyz_m
        np.testing.assert_allclose(sent_m[at][row], xyz_m, atol=2e-3)
        heading_rad = rollout.heading_rad[:, 11:]
        np.testing.assert_allclose(sent.heading_rad[at][row], heading_rad, atol=1e-6)


def test_it_scores_as_the_store_does(record, played, exported):
    ours, theirs = (
        score_files([str(record)], path, "wosac-2025") for path in (played, exported)
    )

    assert len(ours.scores) == 1
    assert theirs.scores == ours.scores
    assert not ours.refused
