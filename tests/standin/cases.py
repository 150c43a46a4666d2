"""What is done on the stand-in device, each in a process of its own.

``python -m tests.standin.cases NAME [ARGUMENTS]`` prints what it found as one line of JSON.
"""

import importlib
import json
import os
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, fields, replace
from itertools import islice
from pathlib import Path
from typing import Any

from tests.standin.device import (
    ROOT,
    MixedDevicesError,
    StandIn,
    Tally,
    counted,
    set_up,
)

DEVICE = set_up()

import numpy as np  # noqa: E402
import torch  # noqa: E402

from infgen.config import (  # noqa: E402
    CalibrateSettings,
    ModelSettings,
    RolloutSettings,
    TokenSettings,
    TrainSettings,
)
from infgen.model.batching.batch import Limits, collate  # noqa: E402
from infgen.model.device.index import BatchIndex  # noqa: E402
from infgen.model.device.packed import PackedBatch  # noqa: E402
from infgen.model.network import Network  # noqa: E402
from infgen.model.stepping import Stepper  # noqa: E402
from infgen.model.training.losses import losses  # noqa: E402
from infgen.pretrained import builtin_weights  # noqa: E402
from infgen.rollout.device.insertion import DeviceInsertion  # noqa: E402
from infgen.rollout.precision import make_stepper  # noqa: E402
from infgen.rollout.recording import Frame, RolloutStart  # noqa: E402
from infgen.rollout.session import Session  # noqa: E402
from infgen.rollout.simulator import Simulator  # noqa: E402
from infgen.scene import Scene  # noqa: E402
from infgen.sources.towns import builtin_records  # noqa: E402
from infgen.sources.womd import iter_scenes  # noqa: E402
from infgen.tokens.scene_tokens import Presence  # noqa: E402
from infgen.tokens.tokenizer import tokenize_scene  # noqa: E402
from pipeline.engine.stage import Unit  # noqa: E402
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages  # noqa: E402
from pipeline.stages import calibrate  # noqa: E402
from pipeline.stages.calibration import Biases  # noqa: E402
from pipeline.stages.train import setup  # noqa: E402
from pipeline.stages.train.loader import TokenScenes, train_batches  # noqa: E402
from pipeline.stages.train.optimizer_step import OptimizerStep, StepResult  # noqa: E402
from pipeline.stages.train.process_group import ProcessGroup  # noqa: E402
from pipeline.stages.train.setup import TrainingSetup  # noqa: E402
from pipeline.stages.vocabulary import load_vocabularies  # noqa: E402
from pipeline.storage.checkpoint import (  # noqa: E402
    TrainingState,
    load_checkpoint,
    save_checkpoint,
)
from pipeline.storage.scenes import SCENES_SCHEMA  # noqa: E402
from pipeline.storage.weights import load_network  # noqa: E402
from pipeline.storage.zarr_store import write_records  # noqa: E402
from tests.standin.recorded import RecordedGraph, recorder  # noqa: E402

CPU = torch.device("cpu")
MASK: dict[str, Any] = {
    "rules": "safe",
    "max_motion_samples": 1,
    "reject_off_road": False,
    "max_stall_s": 0.0,
    "density_control": 0.0,
    "insertion_lane_distance_m": 15.0,
    "max_insertion_attempts": 4,
}
"""The insertion mask alone."""
RULES = {
    **MASK,
    "max_motion_samples": 8,
    "reject_off_road": True,
    "max_stall_s": 2.0,
    "density_control": 1.0,
}
OPTIONS: dict[str, dict[str, Any]] = {
    "mask": MASK,
    "rules": RULES,
    "pretrained": {
        **RULES,
        "motion_top_k": 0,
        "motion_top_p": 0.9,
        "position_top_k": 0,
        "max_insertion_attempts": 16,
        "insertion_lane_distance_m": 25.0,
        "add_bias": 0.185,
        "remove_bias": 0.1556,
    },
    "crowded": {
        **MASK,
        "max_agents": 24,
        "max_insertions": 3,
        "add_bias": 1.5,
        "removal_radius_m": 50.0,
    },
    "none": {"add_bias": 1.0},
}
Found = dict[str, Any]


def town() -> Scene:
    """The first built-in scene held out."""
    return towns(1)[0]


def towns(count: int) -> list[Scene]:
    """The first built-in scenes held out."""
    path = next(path for path in builtin_records() if "validation" in path.name)
    scenes = [each for each in islice(iter_scenes(path), count) if isinstance(each, Scene)]
    assert len(scenes) == count
    return scenes


def session(
    device: torch.device,
    count: int,
    settings: dict[str, Any],
    network: Network | None = None,
) -> Session:
    """Start rollouts of a town, with the package's weights if no others are given."""
    network = network or load_network(builtin_weights())
    network = network.to(device).eval()
    length = {} if settings["mode"] == "wosac" else {"seconds": 4.0}
    how = RolloutSettings(**{**length, "batch_rollouts": count, **settings})
    simulator = Simulator(
        make_stepper(network, how.precision),
        network.motion_vocabulary(),
        network.map_vocabulary(),
        network.grid_settings,
        how,
        device,
    )
    scene = town()
    history = tokenize_scene(
        scene, simulator.vocabulary, simulator.roads, simulator.tokens, until=scene.now
    )
    starts = [RolloutStart(scene, history, at, how.seed) for at in range(count)]
    return Session(simulator, starts)


def same(one: Frame, other: Frame) -> bool:
    """Whether two frames have the same agents at the same places, but for rounding.

    A device sums up padding that a CPU leaves out: zeros, but in other groups.
    """
    for name in one.__dataclass_fields__:
        ours, theirs = np.asarray(getattr(one, name)), np.asarray(getattr(other, name))
        close = np.allclose if ours.dtype.kind == "f" else np.array_equal
        if ours.shape != theirs.shape or not close(ours, theirs):
            return False
    return True


def rollout(mode: str, rules: str, steps: str = "3", add_bias: str = "") -> Found:
    """Token steps on both devices, and what the last one of them would cost."""
    settings = {"mode": mode, **OPTIONS[rules]}
    if add_bias:
        settings["add_bias"] = float(add_bias)
    plain = session(CPU, 3, settings)
    with StandIn():
        ours = session(DEVICE, 3, settings)
        equal = [same(ours.step(), plain.step()) for _ in range(int(steps) - 1)]
        with counted() as tally:
            frame = ours.step()
        equal.append(same(frame, plain.step()))
    return {"equal": equal, **costs(tally)}


def insertion(rollouts: str) -> Found:
    """What each pass of insertion costs, and for how many rollouts it was."""
    passes, plain = [], DeviceInsertion._ask

    def asked(engine: Any, running: Any) -> None:
        with counted() as tally:
            plain(engine, running)
        costs = (tally.kernels, tally.waits, tally.copies)
        rollouts = len(running.entries.rollout)
        passes.append([rollouts, *(sum(each.values()) for each in costs)])

    DeviceInsertion._ask = asked  # type: ignore[method-assign]
    with StandIn():
        settings = {"mode": "long", **OPTIONS["pretrained"], "add_bias": 1.0}
        ours = session(DEVICE, int(rollouts), settings)
        ours.step()  # The first passes find the fullest squares of the maps.
        passes.clear()
        ours.step()
    return {"passes": passes}


def graphs(rules: str, precision: str) -> Found:
    """Whether captured passes insert the same, and how many graphs each token step made."""
    settings = {"mode": "long", "precision": precision, **OPTIONS[rules], "add_bias": 1.0}
    captured: list[RecordedGraph] = []
    found: Found = {"equal": [], "inserted": [], "graphs": []}
    with StandIn(), torch.inference_mode():
        ours = session(DEVICE, 16, settings)
        plain = DeviceInsertion(ours._asking)
        other = DeviceInsertion(ours._asking, recorder(captured))
        for _ in range(3):
            request = ours._query_network(ours.population)
            given = request, ours._memory, ours.population, ours.token + 1
            one, two = plain.insert(*given), other.insert(*given)
            alike = [same_bits(one, two, each.name) for each in fields(one)]
            inserted = one.presence == Presence.INSERTED
            found["equal"].append(all(alike))
            found["inserted"].append(int(inserted.sum()))
            found["graphs"].append(len(captured))
            ours.step()
    return found


def same_bits(one: Any, other: Any, name: str) -> bool:
    """Whether an array of two objects is the same."""
    return bool(np.array_equal(getattr(one, name), getattr(other, name)))


def costs(tally: Tally) -> Found:
    """Counts of a tally, and its dearest lines."""
    return {
        "kernels": sum(tally.kernels.values()),
        "waits": sum(tally.waits.values()),
        "words": tally.words(),
    }


def counts(rollouts: str, mode: str, relation_width: str = "0") -> Found:
    """What a token step costs at the paper's sizes."""
    known = load_network(builtin_weights())
    torch.manual_seed(0)
    network = Network(
        ModelSettings(relation_width=int(relation_width)),
        known.motion_vocabulary(),
        known.map_vocabulary(),
        known.grid_settings,
    )
    with StandIn():
        ours = session(DEVICE, int(rollouts), {"mode": mode}, network)
        ours.step()
        with counted() as tally:
            ours.step()
    return costs(tally)


TINY = ModelSettings(
    width=16, heads=2, map_blocks=1, motion_blocks=1, scene_blocks=1, fourier_bands=4,
    dropout=0.0,
)  # fmt: skip
FEATURES = {
    "cell_feature_width": 8,
    "motion_feature_width": 8,
    "ego_embedding": True,
    "map_agent_lookahead_m": 10.0,
    "map_agent_lateral_offset": True,
    "signals_each_step": True,
    "signal_ahead_m": 40.0,
}
SIZES = ("width", "heads", "map_blocks", "motion_blocks", "scene_blocks", "fourier_bands")
VARIANTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "paper": ({}, {}),
    "features": (FEATURES, {"motion_noise_neighbours": 5, "map_noise_neighbours": 3}),
    "rotary": (
        {**FEATURES, "relations": "rotary", "map_agent_lateral_offset": False},
        {"motion_noise_neighbours": 5},
    ),
    "closed-loop": (FEATURES, {"closed_loop_top_k": 4}),
    "closed-loop-population": (
        {
            **FEATURES,
            "density_features": True,
            "ego_features": True,
            "standing_features": True,
            "removal_features": True,
            "approach_features": True,
            "clearance_width": 4,
            "edge_clearance_width": 4,
            "last_move_head": True,
            "over_edge_head": True,
            "latent_rates": True,
        },
        {
            "motion_noise_neighbours": 5,
            "closed_loop_population": True,
            "own_insertion_share": 0.5,
        },
    ),
    "offset-token": (
        {
            **FEATURES,
            "offset_token": True,
            "placement_features": True,
            "cell_refinement_width": 4,
            "agent_spacing_width": 4,
        },
        {"closed_loop_population": True, "trained_parts": "details, motion"},
    ),
    "accumulated": ({}, {"gradient_accumulation": 2}),
    "smart": ({"insertion_and_removal": False}, {}),
    "no-remove-token": ({"remove_token": False}, {}),
    "no-position-token": ({"position_token": False}, {}),
    "no-heading-token": ({"heading_token": False}, {}),
    "patterns": ({"insertion_and_removal": False, "validity_pattern_tokens": True}, {}),
}
"""Settings of the model and of training, by name."""


def course(shards: Path, name: str) -> TrainingSetup:
    """What a training loop is given, for one variant."""
    model, how = VARIANTS[name]
    return TrainingSetup(
        replace(TINY, **model),
        TrainSettings(**{"batch_scenes": 2, "steps": 4, "warmup_steps": 1, **how}),
        TokenSettings(grid_radius_m=60.0, grid_cell_m=4.0),
        TokenScenes([shards / "training"]),
        [],
        shards,
    )


def begun(given: TrainingSetup, device: torch.device) -> TrainingState:
    """Begin training on a device."""
    setup.own_device = lambda: device
    return setup.begin(given, *load_vocabularies(given.folder / "vocab"))


def taken(given: TrainingSetup, state: TrainingState, steps: range) -> StepResult:
    """Do some optimizer steps; return the last one's losses."""
    parts = given.train.gradient_accumulation
    group = ProcessGroup(device=next(state.network.parameters()).device)
    stepper = OptimizerStep(state, given.train, group, parts)
    with closing(train_batches(given.recipe(group), steps, 0)) as batches:
        for step, batch in zip(steps, batches, strict=True):
            found = stepper.step(batch, range(parts), step)
    return found


def training(shards: str, name: str) -> Found:
    """Two optimizer steps on both devices."""
    given = course(Path(shards), name)
    plain = begun(given, CPU)
    expected = taken(given, plain, range(2))
    with StandIn():
        state = begun(given, DEVICE)
        taken(given, state, range(1))
        with counted() as tally:
            found = taken(given, state, range(1, 2))
        ours = {key: float(term.loss) for key, term in found.terms.items()}
        moved = {key: p.detach().cpu() for key, p in state.network.named_parameters()}
    theirs = {key: float(term.loss) for key, term in expected.terms.items()}
    apart = [
        float((moved[key] - p.detach()).abs().max())
        for key, p in plain.network.named_parameters()
    ]
    return {"ours": ours, "theirs": theirs, "apart": max(apart), **costs(tally)}


def low_precision(shards: str, profile: str) -> Found:
    """Two optimizer steps in bf16 and in float32, of tiny networks of a profile."""
    stages = load_stages(DEFAULT_FILE, {}).choose(profile)
    tiny = {name: getattr(TINY, name) for name in SIZES}
    model = replace(stages.build("model", ModelSettings), **tiny)
    how = stages.build("train", TrainSettings)
    how = replace(how, batch_scenes=2, steps=2, warmup_steps=0, initial_weights="")
    given = replace(course(Path(shards), "paper"), model=model)
    found: Found = {}
    with StandIn():
        for precision in ("bf16", "float32"):
            given = replace(given, train=replace(how, precision=precision))
            terms = taken(given, begun(given, DEVICE), range(2)).terms
            found[precision] = {key: float(term.loss) for key, term in terms.items()}
    return found


def step_costs(scenes: str) -> Found:
    """What an optimizer step of the paper's network costs, with dropout, on towns."""
    known = load_network(builtin_weights())
    books = known.motion_vocabulary(), known.map_vocabulary()
    grid, count = known.grid_settings, int(scenes)
    records = [tokenize_scene(scene, *books, grid) for scene in towns(count)]
    how = TrainSettings(batch_scenes=count, warmup_steps=0)
    limits = Limits.of(ModelSettings(), how, grid)
    setup.own_device = lambda: DEVICE
    with StandIn():
        given = TrainingSetup(ModelSettings(), how, grid, TokenScenes([]), [], Path())
        state = setup.begin(given, *books)
        stepper = OptimizerStep(state, how, ProcessGroup(device=DEVICE), 1)
        for step in range(2):
            batch = PackedBatch.of(collate(records, limits, step)).pin()
            with counted() as tally:
                stepper.step([batch], range(1), step)
    return costs(tally)


def calibrated(folder: str) -> Found:
    """Count simulated traffic for calibration on both devices, from one scene."""
    scene = town()
    write_records(
        Path(folder) / "scenes-000.zarr", [scene], Scene, SCENES_SCHEMA, compress=True
    )
    unit = Unit(
        name="biases-0-000",
        inputs={"weights": "weights"},
        task={
            "weights": str(builtin_weights()),
            "biases": asdict(Biases(0.2, 0.1)),
            "point": 0,
            "pieces": [{"scenes": folder, "rows": [0]}],
            "device": "cpu",  # Of the network that is replaced below.
        },
    )
    settings = {
        "tokenize": load_network(builtin_weights()).grid_settings,
        "rollout": RolloutSettings(seconds=2.0, count=1),
        "calibrate": CalibrateSettings(method="simulate"),
    }

    def counts(device: torch.device) -> Found:
        load = calibrate.load_simulator

        def moved(*arguments: Any) -> tuple[Simulator, str]:
            simulator, weights = load(*arguments)
            network = load_network(builtin_weights()).to(device).eval()
            return replace(simulator, stepper=Stepper(network), device=device), weights

        calibrate.load_simulator = moved
        try:
            return calibrate.work(
                unit, Path(folder) / device.type, settings, lambda *_: None
            )
        finally:
            calibrate.load_simulator = load

    plain = counts(CPU)
    with StandIn():
        return {"ours": counts(DEVICE), "theirs": plain}


def resuming(shards: str, folder: str) -> Found:
    """Save, load, go on: as if training had never stopped."""
    given = course(Path(shards), "paper")
    with StandIn():
        state = begun(given, DEVICE)
        taken(given, state, range(2))
        save_checkpoint(Path(folder), state, 2)
        taken(given, state, range(2, 3))
        resumed = begun(given, DEVICE)
        step = load_checkpoint(Path(folder), resumed)
        devices = {
            str(value.device)
            for each in resumed.optimiser.state.values()
            for value in each.values()
        }
        taken(given, resumed, range(step, step + 1))
        pairs = zip(state.network.parameters(), resumed.network.parameters(), strict=True)
        equal = all(torch.equal(one, other) for one, other in pairs)
    return {"devices": sorted(devices), "equal": equal, "step": step}


def compiled(shards: str, name: str, profile: str = "") -> Found:
    """The network traced by the compiler, but not compiled, against the network itself.

    The sizes are tiny; all other settings of the model are a profile's, if one is named.
    """
    given = course(Path(shards), name)
    if profile:
        own = load_stages(DEFAULT_FILE, {}).choose(profile).build("model", ModelSettings)
        tiny = {name: getattr(TINY, name) for name in (*SIZES, "dropout")}
        given = replace(given, model=replace(own, **tiny))
    network = begun(given, CPU).network
    batch = given.recipe(ProcessGroup())[0][0]
    how = {"hidden_roads": True, "index": BatchIndex.of(batch)}
    # Training has symbolic shapes, which take the compiler minutes: one profile has them.
    dynamic = True if profile in ("", "benchmark") else None
    traced = torch.compile(network, dynamic=dynamic, backend="eager")
    plain = losses(network(batch, **how), batch, given.train)
    found = losses(traced(batch, **how), batch, given.train)
    return {
        "ours": {key: float(term.loss) for key, term in found.items()},
        "theirs": {key: float(term.loss) for key, term in plain.items()},
    }


def device() -> Found:
    """What the device refuses, and what it counts as waiting."""
    with StandIn():
        ones = torch.ones(4).to(DEVICE)
        refused = []
        for other in (torch.ones(4), torch.tensor(2.0)):
            try:
                ones + other
            except MixedDevicesError as error:
                refused.append(str(error).splitlines()[0])
        waits = {
            "to the device": lambda: torch.ones(4).to(DEVICE),
            "from pinned memory": lambda: (
                torch.ones(4).pin_memory().to(DEVICE, non_blocking=True)
            ),
            "to the host": lambda: ones.cpu(),
            "a number": lambda: float(ones.sum()),
            "places of a mask": lambda: ones[ones > 0],
            "a sum": lambda: ones.sum(),
        }
        found = {}
        for name, act in waits.items():
            with counted() as tally:
                act()
            found[name] = [sum(tally.kernels.values()), sum(tally.waits.values())]
        leaf = torch.ones(4).to(DEVICE).requires_grad_()
        (torch.nn.functional.linear(leaf, torch.eye(4).to(DEVICE)) ** 2).sum().backward()
        gradient = leaf.grad.cpu().tolist() if leaf.grad is not None else []
    return {"refused": refused, "counts": found, "gradient": gradient}


def types() -> Found:
    """The types that autocast gives, and whether a mixture of two is refused."""
    lerp, norm = torch.lerp, torch.nn.functional.layer_norm
    with StandIn():
        ones = torch.ones(2, 2).to(DEVICE)
        low = ones.bfloat16()
        with torch.autocast(DEVICE.type, torch.bfloat16):
            made = {
                "linear": torch.nn.functional.linear(ones, ones),
                "added": low + low,
                "softmax": low.softmax(-1),
                "norm": norm(low, (2,), ones[0], ones[0]),
            }
        mixtures = {
            "lerp": lambda: lerp(low, low, ones),
            "norm": lambda: norm(low, (2,), ones[0], ones[0]),
        }
        refused = {}
        for name, mix in mixtures.items():
            try:
                mix()
            except RuntimeError as error:
                refused[name] = type(error).__name__
    return {"made": {name: str(x.dtype) for name, x in made.items()}, "refused": refused}


def benchmarks(name: str) -> Found:
    """Measure a small row of a benchmark, as its process on a GPU would."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    measuring = importlib.import_module("measuring")
    measuring.PEAK_SIDE = 64
    benchmark = importlib.import_module(name)
    device = str(DEVICE)
    cases = {
        "rollout": {
            "size": "small", "batch": 2, "mode": "long", "played": "masked",
            "seconds": 1.0, "agents": 6, "roads": 100, "device": device, "threads": 1,
        },
        "training": {
            "size": "small", "scenes": 1, "neighbours": 5, "device": device, "threads": 1,
            "precision": "float32",
        },
    }  # fmt: skip
    with StandIn():
        row: Found = benchmark.measure(benchmark.Case(**cases[name]))
    return row


def gpu_rows() -> Found:
    """Measure small rows of ``benchmarks/gpu.py``."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    rows = importlib.import_module("gpu_rows")
    place = rows.Place(str(DEVICE), 1, 0.0, small=True)
    asked = [
        rows.Row("logits", "tiny", 1, "float32"),
        rows.Row("choices", "builtin", 2, "float32"),
        rows.Row("choices", "builtin", 2, "bf16"),
        rows.Row("rollouts", "tiny", 2, "bf16"),
        rows.Row("training", "tiny", 1, "bf16"),
    ]
    with StandIn():
        return {row.name: rows.measure(row, place) for row in asked}


CASES: dict[str, Callable[..., Found]] = {
    "benchmarks": benchmarks,
    "calibrated": calibrated,
    "compiled": compiled,
    "counts": counts,
    "device": device,
    "gpu_rows": gpu_rows,
    "graphs": graphs,
    "insertion": insertion,
    "low_precision": low_precision,
    "resuming": resuming,
    "rollout": rollout,
    "step": step_costs,
    "training": training,
    "types": types,
}

if __name__ == "__main__":
    print(json.dumps(CASES[sys.argv[1]](*sys.argv[2:])), flush=True)  # noqa: T201
    # PyTorch's gradient thread of the device may still hold Python objects: when the
    # interpreter is taken down under it, the process now and then aborts.
    os._exit(0)
