"""Batches are the same whoever makes them, and wherever training begins."""

import json
import os
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from infgen.model.batching.perturbation import make_perturbation
from infgen.model.batching.tensors import map_tensors
from pipeline.stages.train.loader import (
    TokenScenes,
    draw_of_step,
    made_by_processes,
    train_batches,
    validation_batches,
)
from pipeline.stages.train.process_group import ProcessGroup


def numbers(parts):
    """All tensors of some batches, one after the other."""
    found = []
    map_tensors(parts, lambda tensor: found.append(tensor) or tensor)
    return found


def assert_same(one, other):
    pairs = list(zip(numbers(one), numbers(other), strict=True))
    assert pairs
    assert all(torch.equal(a, b) for a, b in pairs)
    assert [b.scenario_ids for b in one] == [b.scenario_ids for b in other]


def test_every_step_and_seed_has_its_own_draw():
    draws = {draw_of_step(step, seed) for step in range(50) for seed in range(50)}

    assert len(draws) == 2500


def test_the_batch_of_a_step_does_not_depend_on_where_training_began(setup):
    recipe = setup.recipe(ProcessGroup())
    from_start = list(train_batches(recipe, range(5), 0))
    from_three = list(train_batches(recipe, range(3, 5), 0))

    for one, other in zip(from_start[3:], from_three, strict=True):
        assert_same(one, other)


@pytest.mark.parametrize("workers", [1, 2])
def test_the_batch_of_a_step_does_not_depend_on_who_makes_it(setup, workers):
    recipe = setup.recipe(ProcessGroup())

    by_thread = list(train_batches(recipe, range(5), 0))
    by_workers = list(train_batches(recipe, range(5), workers))

    assert len(by_workers) == 5
    for one, other in zip(by_thread, by_workers, strict=True):
        assert_same(one, other)


@pytest.mark.parametrize("workers", [0, 1])
def test_noise_is_the_same_whoever_makes_it_and_never_in_held_out_scenes(
    setup, books, workers
):
    recipe = setup.recipe(ProcessGroup())
    noise = make_perturbation(replace(setup.train, motion_noise_neighbours=3), *books)
    noisy = replace(recipe, noise=noise)

    made = list(train_batches(noisy, range(3), workers))

    for step, parts in enumerate(made):
        assert_same(noisy[step], parts)
        logged = recipe[step][0].agents
        assert torch.equal(logged.presence, parts[0].agents.presence)
        assert not torch.equal(logged.label, parts[0].agents.label)
    (validation_split,) = validation_batches(setup.validation_split, setup.limits, 9, 0, 9)
    assert torch.equal(validation_split.agents.label, validation_split.agents.motion_token)


def test_a_packed_batch_unpacks_to_itself_and_the_places_that_hold_something(setup):
    recipe = setup.recipe(ProcessGroup())
    packed = replace(recipe, packed=True)

    for step, made in enumerate(made_by_processes(packed, range(2), 1)):
        (plain,), (found,) = recipe[step], made
        unpacked = found.unpack(torch.device("cpu"))
        assert_same([unpacked.batch], [plain])
        assert found.scenario_ids == plain.scenario_ids
        index, agents = unpacked.index, plain.agents
        assert index.visible.pack(agents.visible).all()
        assert len(index.visible.at) == agents.visible.sum()
        assert len(index.described.at) == plain.details.present.sum()
        assert len(index.asked.at) == plain.entries.asked.sum()
        hidden = torch.zeros_like(plain.roads.real).flatten()
        hidden[index.roads.hidden] = True
        assert torch.equal(hidden.view_as(plain.roads.real), plain.roads.predicted)
        before = index.roads.rows.at[index.roads.before]
        assert torch.equal(before, index.roads.hidden - 1)


@pytest.mark.parametrize("workers", [0, 1])
def test_whoever_stops_early_leaves_nothing_behind(setup, workers):
    with closing(
        train_batches(setup.recipe(ProcessGroup()), range(1000), workers)
    ) as batches:
        next(batches)


def test_an_error_while_a_batch_is_made_comes_through(setup):
    recipe = setup.recipe(ProcessGroup())
    broken = replace(recipe, order=replace(recipe.order, size=np.zeros((9, 2), int)))

    with pytest.raises(IndexError, match="of 3"):
        list(train_batches(broken, range(4), 0))


def test_parts_of_a_batch_are_together_the_batch(setup):
    how = replace(setup.train, batch_scenes=3, gradient_accumulation=1)
    wide = replace(setup, train=how).recipe(ProcessGroup())
    parts = [
        replace(setup, train=how).recipe(ProcessGroup(rank, 3))[7][0].scenario_ids
        for rank in range(3)
    ]

    assert sum(parts, ()) == wide[7][0].scenario_ids
    own = replace(setup, train=replace(how, gradient_accumulation=3)).recipe(ProcessGroup())
    assert [part.scenario_ids for part in own[7]] == parts


def test_held_out_batches_are_the_same_each_time_and_no_more_than_asked_for(setup):
    first, again = (
        [
            b.scenario_ids
            for b in validation_batches(setup.validation_split, setup.limits, 2, 0, 3)
        ]
        for _ in range(2)
    )

    assert first == again
    assert [len(ids) for ids in first] == [2, 1]


def test_scenes_of_several_groups_are_one_sequence(shards):
    scenes = TokenScenes([shards / "training", shards / "validation"])

    assert len(scenes) == 6
    assert scenes[3].scenario_id == "validation-0"
    assert [scene.scenario_id for scene in scenes[4:]] == ["validation-1", "validation-2"]
    with pytest.raises(IndexError):
        scenes[6]


OVER_MANY_SHARDS = """
import json, os, resource, sys
from pathlib import Path
from infgen.config import ModelSettings, TokenSettings, TrainSettings
from infgen.model.batching.tensors import map_tensors
from pipeline.stages.train.setup import TrainingSetup
from pipeline.stages.train.process_group import ProcessGroup
from pipeline.stages.train.loader import TokenScenes, train_batches

def main():
    shards, count, workers = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    scenes = TokenScenes([shards] * count)
    grid = TokenSettings(grid_radius_m=60.0, grid_cell_m=4.0)
    how = TrainSettings(batch_scenes=3 * count)
    setup = TrainingSetup(ModelSettings(), how, grid, scenes, [], shards)
    recipe = setup.recipe(ProcessGroup())
    ids = [parts[0].scenario_ids for parts in train_batches(recipe, range(2), workers)]
    maps = Path("/proc/self/maps").read_text()
    print(json.dumps([ids, len(os.listdir("/proc/self/fd")), str(shards) in maps]))

if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_NOFILE, (128, 128))
    main()
"""


@pytest.mark.parametrize("workers", [0, 1])
def test_there_may_be_more_shards_than_files_that_may_be_open(shards, tmp_path, workers):
    # In a process of its own: nobody may raise the limit again.
    script = tmp_path / "over_many_shards.py"
    script.write_text(OVER_MANY_SHARDS)
    root = Path(__file__).parents[4]
    done = subprocess.run(
        [sys.executable, script, shards / "training", "150", str(workers)],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(root)},
        timeout=240,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    ids, descriptors, mapped = json.loads(done.stdout)
    once = sorted(f"training-{i}" for i in range(3) for _ in range(150))
    assert [sorted(batch) for batch in ids] == [once, once]
    assert descriptors < 32
    assert not mapped


def test_sizes_are_known_without_reading_scenes(shards, setup):
    scenes = TokenScenes([shards / "training", shards / "validation"])
    limits = replace(setup.limits, roads=30, tokens=10)

    expected = [(s.num_agents * min(s.num_tokens, 10), 30) for s in scenes]

    np.testing.assert_array_equal(scenes.sizes(limits), expected)
    assert TokenScenes([]).sizes(limits).shape == (0, 2)
