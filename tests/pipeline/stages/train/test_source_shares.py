"""Sources are read as often as their shares say, in any process, and after a restart."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from infgen.config import TrainSettings
from infgen.errors import ConfigError
from infgen.settings import build
from pipeline.stages.train.loader import TokenScenes
from pipeline.stages.train.process_group import ProcessGroup
from pipeline.stages.train.sampler import ScenePermutation
from pipeline.stages.train.source_shares import check_shares, mix, read_shares
from pipeline.stages.train.stage import plan
from tests.pipeline.stages.train.test_stage import MadeInputs

SOURCES, COUNTS = ("tfrecord", "argoverse2", "tfrecord"), (30, 5, 10)
"""Three shards: 40 scenes of one source, five of the other."""


def order(words, batch=4, pool=3, seed=5):
    sizes = np.column_stack([np.arange(45) % 7, np.arange(45) % 5])
    mixture = mix(read_shares(words), SOURCES, COUNTS)
    return ScenePermutation(sizes, batch, pool, seed, mixture)


def read(reads, steps):
    return [row for step in range(steps) for row in reads.scenes(step)]


def share_of_argoverse(rows):
    return np.mean([30 <= row < 35 for row in rows])


@pytest.mark.parametrize("share", [0.1, 0.5, 0.75])
def test_a_source_is_read_as_often_as_its_share_says(share):
    reads = order(f"argoverse2:{share},tfrecord:{1 - share}")

    for epoch in range(3):
        whole = reads.epoch_scenes // 4
        rows = read(reads, 3 * whole)[epoch * reads.epoch_scenes :][: reads.epoch_scenes]
        assert share_of_argoverse(rows) == pytest.approx(share, abs=0.01)


def test_shares_may_have_any_sum_and_zero_leaves_a_source_out():
    assert read(order("tfrecord:3,argoverse2:1"), 30) == read(
        order("argoverse2:0.25, tfrecord:0.75"), 30
    )
    assert share_of_argoverse(read(order("tfrecord:1,argoverse2:0"), 60)) == 0


def test_scenes_of_one_source_are_read_equally_often():
    reads = order("tfrecord:1,argoverse2:1", batch=5)

    times = Counter(read(reads, reads.epoch_scenes * 4 // 5))

    for rows in (range(30, 35), [*range(30), *range(35, 45)]):
        assert max(times[row] for row in rows) - min(times[row] for row in rows) <= 1


def test_what_a_step_reads_follows_from_its_number_and_the_seed():
    words = "tfrecord:1,argoverse2:2"
    later = [order(words).scenes(step) for step in range(60, 80)]

    reads = order(words)
    assert [reads.scenes(step) for step in range(80)][60:] == later
    assert [order(words, seed=6).scenes(step) for step in range(60, 80)] != later


def test_without_shares_scenes_are_read_as_they_are():
    sizes = np.column_stack([np.arange(9), np.arange(9)])
    reads = ScenePermutation(sizes, 3, 1, 5)

    assert sorted(read(reads, 3)) == list(range(9))
    random = np.random.default_rng([5, 0])
    assert read(reads, 3) == random.permutation(9).tolist()


def test_a_source_without_scenes_cannot_have_a_share():
    with pytest.raises(ConfigError, match="argoverse2 a share, but it has no scenes"):
        mix({"tfrecord": 1.0, "argoverse2": 1.0}, SOURCES, (30, 0, 10))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("scenarionet:1,tfrecord:1", "names scenarionet, but the training split has"),
        ("tfrecord:1", "gives argoverse2 no share; add argoverse2:0"),
        ("tfrecord:0,argoverse2:0", "leaves out every source"),
    ],
)
def test_shares_of_other_sources_than_there_are_are_refused(words, said):
    with pytest.raises(ConfigError, match=said):
        check_shares(read_shares(words), SOURCES)


def test_a_source_named_twice_is_refused():
    with pytest.raises(ConfigError, match="names tfrecord twice"):
        read_shares("tfrecord:1,tfrecord:2")


@pytest.mark.parametrize("words", ["half", "tfrecord:-1", "tfrecord:1;argoverse2:1"])
def test_words_that_are_no_shares_are_a_wrong_setting(words):
    with pytest.raises(ConfigError, match="expected sources and shares, as tfrecord:2"):
        build(TrainSettings, {"source_share": words}, "train")


class MixedInputs(MadeInputs):
    """Token shards of two sources."""

    names = ("training.argoverse2-00000-of-00001", "training.tfrecord-1")


def test_the_plan_names_the_source_of_every_shard_and_checks_shares(train_settings):
    (unit,) = plan(MixedInputs(), train_settings)
    assert unit.task["sources"] == ["argoverse2", "tfrecord"]

    wrong = replace(train_settings["train"], source_share="tfrecord:1")
    with pytest.raises(ConfigError, match="argoverse2 no share"):
        plan(MixedInputs(), {**train_settings, "train": wrong})


def test_processes_read_their_parts_of_the_same_steps(shards, setup):
    scenes = TokenScenes([shards / "training", shards / "validation"])
    assert scenes.shard_sizes == [3, 3]
    how = replace(setup.train, batch_scenes=4, source_share="argoverse2:9,tfrecord:1")
    setup = replace(
        setup, scenes=scenes, train=how, sources=("argoverse2", "tfrecord"), folder=Path()
    )
    cpu = torch.device("cpu")

    whole = setup.recipe(ProcessGroup(0, 1, cpu))
    parts = [setup.recipe(ProcessGroup(rank, 2, cpu)) for rank in range(2)]

    rows = [whole.rows(step, 0) for step in range(whole.order.epoch_scenes // 4)]
    for step, own in enumerate(rows[:9]):
        found = [row for p in parts for part in p.own for row in p.rows(step, part)]
        assert sorted(found) == sorted(own)
    assert np.mean(np.array(rows) < 3) == pytest.approx(0.9)
