"""Precision of rollouts: matrix products lose bits, geometry and sampling never do."""

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import infgen
from infgen.config import RolloutSettings
from infgen.model.sampling import choose
from infgen.model.stepping import Stepper
from infgen.pretrained import builtin_weights
from infgen.rollout.precision import PrecisionStepper, describe_precision, make_stepper
from infgen.rollout.recording import RolloutStart
from infgen.rollout.session import Session
from infgen.rollout.simulator import Simulator
from infgen.sources.towns import builtin_records
from infgen.sources.womd import iter_scenes
from infgen.tokens.tokenizer import tokenize_scene
from pipeline.storage.weights import load_network

GEOMETRY = {
    "relations.py", "map_grid.py", "relation_tables.py", "neighbours.py",
    "signal_features.py", "cell_features.py", "step_memory.py", "session.py", "sampling.py",
}  # fmt: skip
FEATURES = {"relations.py:pack", "relations.py:spread", "signal_features.py:forward"}
"""Functions of these files that handle features, which may lose bits."""
STEPS, ROLLOUTS = 6, 3
AGREEMENT = 0.93
"""Share of the motion tokens that are sampled alike in bf16 and float32; 0.96 was found."""


class Recorder(Stepper):
    """A stepper that keeps what it was shown and what it said."""

    def encode_maps(self, roads):
        self.roads = roads
        return super().encode_maps(roads)

    def begin_on(self, maps, scene, rows):
        self.begun, self.steps = (scene, rows), []
        return super().begin_on(maps, scene, rows)

    def motion_step(self, memory, token_step, rows=None):
        said = super().motion_step(memory, token_step, rows)
        self.steps.append((token_step, rows, said))
        return said


class Bf16Lines(TorchDispatchMode):
    """Counts, by function of the package, operations that make bfloat16 tensors."""

    def __init__(self):
        super().__init__()
        self.counts = defaultdict(int)

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        found = func(*args, **(kwargs or {}))
        made = found if isinstance(found, tuple | list) else (found,)
        if any(isinstance(x, torch.Tensor) and x.dtype == torch.bfloat16 for x in made):
            self.counts[innermost()] += 1
        return found


def innermost():
    frame, root = sys._getframe(1), str(Path(infgen.__file__).parent)
    while frame is not None and not frame.f_code.co_filename.startswith(root):
        frame = frame.f_back
    if frame is None:
        return ""
    return f"{Path(frame.f_code.co_filename).name}:{frame.f_code.co_name}"


@pytest.fixture(scope="module")
def network():
    return load_network(builtin_weights()).eval()


@pytest.fixture(scope="module")
def session(network):
    """``session(stepper, **settings)``: rollouts of a built-in town."""
    path = next(path for path in builtin_records() if "validation" in path.name)
    scene = next(iter(iter_scenes(path)))
    books = network.motion_vocabulary(), network.map_vocabulary()
    history = tokenize_scene(scene, *books, network.grid_settings, until=scene.now)

    def build(stepper, **settings):
        how = RolloutSettings(seconds=10.0, **settings)
        starts = [RolloutStart(scene, history, at, how.seed) for at in range(ROLLOUTS)]
        cpu = torch.device("cpu")
        return Session(Simulator(stepper, *books, network.grid_settings, how, cpu), starts)

    return build


@pytest.fixture(scope="module")
def recorded(network, session):
    """A few token steps in float32: what the network was shown and said."""
    recorder = Recorder(network)
    running = session(recorder)
    for _ in range(STEPS):
        running.step()
    return recorder


@pytest.fixture(scope="module")
def bf16(network, recorded):
    """The same token steps in bfloat16: the memory, the answers, and who made bfloat16."""
    stepper = make_stepper(network, "bf16")
    with Bf16Lines() as lines:
        memory = stepper.begin(recorded.roads, *recorded.begun)
        said = [stepper.motion_step(memory, *shown) for *shown, _ in recorded.steps]
    return memory, said, lines.counts


def test_geometry_is_float32_and_products_are_bf16(recorded, bf16):
    memory, said, counts = bf16

    assert memory.pose.dtype == torch.float32
    assert said[-1].packed.motion_logits.dtype == torch.float32
    strange = {name for name in counts if name.split(":")[0] in GEOMETRY} - FEATURES
    assert not strange
    assert sum(n for name, n in counts.items() if "neighbour_attention.py" in name) > 0
    for at, (column, _, _) in enumerate(recorded.steps):
        place = at % memory.window
        if at >= len(recorded.steps) - memory.window:
            assert torch.equal(memory.pose[:, :, place], column.pose)


def test_bf16_and_float32_choose_alike(recorded, bf16):
    same, gap = [], 0.0
    for (_, _, theirs), ours in zip(recorded.steps, bf16[1], strict=True):
        one, other = theirs.packed.motion_logits, ours.packed.motion_logits
        gap = max(gap, float((one - other).abs().max()))
        uniform = torch.linspace(0.01, 0.99, len(one), dtype=torch.float64)
        same.append(choose(one, uniform, 5) == choose(other, uniform, 5))
    share = float(torch.cat(same).double().mean())

    assert gap > 0, "bf16 was not used"
    assert share >= AGREEMENT, share


def test_rollouts_in_bf16_run_with_insertion_and_all_rules(network, session):
    stepper = make_stepper(network, "bf16")
    running = session(
        stepper,
        rules="safe",
        max_motion_samples=4,
        add_bias=6.0,
    )

    frames = [running.step() for _ in range(2)]

    assert all(np.isfinite(frame.path).all() for frame in frames)
    assert any((frame.inserted_number >= 0).any() for frame in frames)


@pytest.mark.parametrize("word", ["auto", "float32"])
def test_on_a_cpu_other_words_change_nothing(network, word):
    assert type(make_stepper(network, word)) is Stepper


@pytest.mark.parametrize(("word", "wanted"), [("auto", "high"), ("float32", "highest")])
def test_tf32_is_allowed_within_a_step_only(network, monkeypatch, word, wanted):
    stepper = PrecisionStepper(network, word)
    stepper._device_type = "cuda"  # What the switches are set to, not what they do.
    before = torch.get_float32_matmul_precision()

    with stepper._context_of_products():
        assert torch.get_float32_matmul_precision() == wanted
        assert torch.backends.cudnn.allow_tf32 == (word == "auto")
    assert torch.get_float32_matmul_precision() == before


@pytest.mark.parametrize(
    ("word", "device_type", "name"),
    [
        ("auto", "cpu", "float32"),
        ("auto", "cuda", "TF32"),
        ("float32", "cuda", "float32"),
        ("bf16", "cpu", "bf16"),
    ],
)
def test_precision_has_a_name(word, device_type, name):
    assert describe_precision(word, device_type) == name


def test_every_question_of_a_stepper_is_asked_in_that_precision():
    methods = {name for name, each in vars(Stepper).items() if callable(each)}

    assert {name for name in methods if name[0] != "_"} <= set(vars(PrecisionStepper))
