"""Half the bits give nearly the same; the compiler gives the same, or is done without."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from pydantic import ValidationError

from infgen.config import TrainSettings
from infgen.model.training.losses import figures, losses
from pipeline.stages.train.loop import train
from pipeline.stages.train.precision import Pass
from pipeline.stages.train.process_group import ProcessGroup
from pipeline.stages.train.setup import begin


@pytest.fixture
def batch(setup):
    return setup.recipe(ProcessGroup())[0][0]


@pytest.fixture
def network(setup, books):
    sharp = replace(setup, model=replace(setup.model, dropout=0.0))
    return begin(sharp, *books).network


def test_bf16_gives_nearly_the_same_losses_in_float32(network, batch):
    terms = {}
    for precision in ("float32", "bf16"):
        how = TrainSettings(precision=precision)
        outputs = Pass(network, how)(batch)
        assert outputs.motion.motion_logits.dtype == torch.float32
        terms[precision] = figures(losses(outputs, batch, how))

    for name in ("motion", "keep", "add", "position", "agent_type", "heading", "map"):
        sharp, rough = terms["float32"][name], terms["bf16"][name]
        assert rough == pytest.approx(sharp, rel=0.02), name
        assert rough != sharp, name


def test_training_in_bf16_goes_on_to_finite_weights(setup, books, quiet):
    how = replace(setup.train, precision="bf16", steps=1)
    training = begin(setup, *books)

    found = train(replace(setup, train=how), training, quiet)

    assert found.run["bf16"]
    assert all(p.dtype == torch.float32 for p in training.network.parameters())
    assert all(torch.isfinite(p).all() for p in training.network.parameters())


def test_without_a_gpu_auto_is_float32_and_not_compiled(network):
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    forward = Pass(network, TrainSettings())

    assert not forward.bf16
    assert not forward.compiled


SCRIPT = """
import json, sys, warnings
from pathlib import Path
import torch
from infgen.config import *
from pipeline.stages.train.setup import TrainingSetup, begin
from pipeline.stages.train.process_group import ProcessGroup
from pipeline.stages.train.loader import TokenScenes
from pipeline.stages.train.precision import Pass
from pipeline.stages.vocabulary import load_vocabularies

shards = Path(sys.argv[1])
scenes = TokenScenes([shards / "training"])
model = ModelSettings(
    width=16, heads=2, map_blocks=1, motion_blocks=1, scene_blocks=1, fourier_bands=4,
    dropout=0.0,
)
grid = TokenSettings(grid_radius_m=60.0, grid_cell_m=4.0)
course = TrainingSetup(model, TrainSettings(batch_scenes=2), grid, scenes, [], shards)
network = begin(course, *load_vocabularies(shards / "vocab")).network
batch = course.recipe(ProcessGroup())[0][0]
plain = Pass(network, TrainSettings(compile="false"))(batch)
forward = Pass(network, TrainSettings(compile="true"))
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    found = forward(batch)
same = torch.equal(found.motion.motion_logits, plain.motion.motion_logits)
told = [str(each.message) for each in told if each.category is UserWarning]
print(json.dumps([forward.compiled, same, told]))
"""


@pytest.mark.slow
def test_a_compiler_that_fails_is_done_without(shards):
    # In a process of its own: the compiler cannot see through the checks of shapes.
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(shards)],
        capture_output=True,
        text=True,
        env={**os.environ, "CXX": "/no/such/compiler", "OMP_NUM_THREADS": "1"},
        cwd=Path(__file__).parents[4],
        timeout=240,
        check=True,
    )

    compiled, same, told = json.loads(done.stdout)
    assert (compiled, same) == (False, True)
    assert any("going on without compiling" in line for line in told)


@pytest.mark.parametrize(("name", "word"), [("precision", "fp8"), ("compile", "maybe")])
def test_other_words_are_refused(name, word):
    with pytest.raises(ValidationError, match=rf"{name}\s+Input should be 'auto'"):
        TrainSettings(**{name: word})
