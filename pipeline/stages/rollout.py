"""Stage ``rollout``: weights and the first second of every scene to rollouts.

One unit is some scenes of one shard with all their rollouts, so a task is long beside its
overhead. What a rollout does depends on its scene, its index and the seed alone; its last
bits depend on the batch it is in, which on a CPU holds rollouts of one scene only.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.config import RolloutSettings
from pipeline.engine.stage import FinishedUnit, Inputs, Progress, Report, Stage, Unit
from pipeline.stages.batch_memory import BatchSize
from pipeline.stages.calibration import Biases, read_found
from pipeline.stages.devices import decide_device, device_of_units, on_device
from pipeline.stages.recorded import collect_recorded, find_recorded, plan_recorded
from pipeline.stages.simulation import (
    about_run,
    begin,
    load_simulator,
    read_some,
    simulate_all,
)
from pipeline.storage.parquet import read_tables
from pipeline.storage.rollouts import INDEX, write_rollouts
from pipeline.storage.splits import files_of_split, spread_evenly

if TYPE_CHECKING:
    from infgen.rollout.recording import RolloutStart
    from infgen.rollout.simulator import Simulator

OF_ENTRIES = (
    "add_bias",
    "density_control",
    "insertion_mask",
    "insertion_lane_distance_m",
    "max_insertion_attempts",
    "max_insertions",
    "position_top_k",
    "position_top_p",
    "offset_top_p",
    "heading_top_p",
    "position_temperature",
    "heading_temperature",
)
OF_EXITS = ("remove_bias", "removal_radius_m")
OF_BOTH = ("latent_rate_scale",)


def normalize(sections: Mapping[str, Any]) -> Mapping[str, Any]:
    """Reset settings of insertion and removal where these are off; all for recordings."""
    settings: RolloutSettings = sections["rollout"]
    if settings.recordings:
        return {"rollout": RolloutSettings(recordings=settings.recordings)}
    idle = (() if settings.inserts else OF_ENTRIES) + (() if settings.removes else OF_EXITS)
    idle += () if settings.inserts or settings.removes else OF_BOTH
    usual = RolloutSettings()
    return {"rollout": replace(settings, **{name: getattr(usual, name) for name in idle})}


def plan(inputs: Inputs, settings: RolloutSettings) -> list[Unit]:
    """Cut each shard, or a part of it, into units of about equally many scenes.

    Raises:
        PlanError: if there is no scene of the split, or recordings are of other records.
    """
    if settings.recordings:
        return plan_recorded(inputs)
    weights = inputs.folder("train")
    identity = inputs.content("train", "model.safetensors", "model.json")
    biases = read_found(inputs.folder("calibrate")).used_by(settings)
    every, device = inputs.units("ingest"), decide_device(settings)
    shards = files_of_split(every, settings.split, to="simulate", setting="rollout.split")
    units = []
    for done, rows in zip(shards, spread_evenly(shards, settings.max_scenes), strict=True):
        for first, after in pairwise(_edges(len(rows), settings.scenes_per_unit)):
            units.append(
                Unit(
                    name=f"{done.name}-{rows[first]:05d}",
                    inputs={"scenes": done.key, "weights": identity},
                    task={
                        "scenes": str(done.path),
                        "weights": str(weights),
                        "biases": asdict(biases),
                        "device": device,
                        "rows": rows[first:after],
                    },
                )
            )
    return units


def _edges(scenes: int, most: int) -> list[int]:
    """Cut scenes into as few parts as may be: where each begins, and the end."""
    parts = math.ceil(scenes / most)
    return [math.ceil(scenes * at / parts) for at in range(parts)] + [scenes]


def simulate(
    unit: Unit, target: Path, settings: RolloutSettings, progress: Progress
) -> Report:
    """Simulate all rollouts of some scenes in batches, and write them as groups."""
    if settings.recordings:
        return collect_recorded(unit, target, progress)
    biases = Biases(**unit.task["biases"])
    settings = on_device(biases.over(settings), unit.task["device"])
    folder, identity = Path(unit.task["weights"]), unit.inputs["weights"]
    simulator, weights = load_simulator(folder, identity, settings)
    starts, refused = _starts(unit, simulator)
    begun, size = time.monotonic(), BatchSize(settings.batch_rollouts)
    where = "" if settings.device == "cpu" else f" on {settings.device}"

    def tell(played: float) -> None:
        progress(played, len(starts), f"{_rate(played, begun):.3g} rollouts/s{where}")

    groups = simulate_all(simulator, starts, weights, tell, size)
    rows = write_rollouts(target, unit.name, groups)
    pace = {"rollouts_per_s": round(_rate(len(rows), begun), 4)}
    run = {**pace, **about_run(simulator, size)}
    told = {
        "add_bias": settings.add_bias,
        "remove_bias": settings.remove_bias,
        "device": settings.device,
        "rules": settings.rules_in_words,
    }
    return {**_report(rows, refused), **told, "simulates": simulator.simulates, "run": run}


def _rate(played: float | int, begun: float) -> float:
    return played / max(time.monotonic() - begun, 1e-9)


def finish(
    inputs: Inputs,
    units: Sequence[FinishedUnit],
    target: Path,
    settings: RolloutSettings,
    progress: Progress,
) -> Report:
    """Write one index of all rollouts, and what they add up to."""
    index = read_tables([done.path for done in units], "index.parquet", INDEX)
    index.write_parquet(target / "index.parquet")
    count = sum(done.report["rollouts"] for done in units)
    totals = {
        name: sum(done.report[name] for done in units)
        for name in ("rollouts", "inserted", "left", "agents")
    }
    means = {
        f"{name}_per_rollout": totals[name] / count if count else 0.0
        for name in ("inserted", "left", "agents")
    }
    refused = [line for done in units for line in done.report["refused"]]
    simulates = sorted({done.report["simulates"] for done in units})
    biases = {name: units[0].report[name] for name in ("add_bias", "remove_bias") if units}
    return {
        "rollouts": count,
        "device": device_of_units(units),
        "simulates": "; ".join(simulates),
        "rules": "; ".join(sorted({done.report["rules"] for done in units})),
        **means,
        **biases,
        "refused": refused,
    }


def _starts(unit: Unit, simulator: "Simulator") -> "tuple[list[RolloutStart], list[str]]":
    """Start all rollouts; scenes that cannot be simulated are named with the reason."""
    task = unit.task
    starts, refused = [], []
    for scene in read_some(Path(task["scenes"]), task["rows"]):
        try:
            starts += begin(simulator, scene)
        except ValueError as error:
            refused.append(f"{scene.scenario_id}: {error}")
    return starts, refused


def _report(rows: list[dict[str, Any]], refused: list[str]) -> Report:
    totals = {
        name: sum(row[name] for row in rows) for name in ("agents", "inserted", "left")
    }
    return {"rollouts": len(rows), **totals, "refused": refused}


STAGE = Stage(
    name="rollout",
    version=15,
    settings={"rollout": RolloutSettings},
    plan=plan,
    work=simulate,
    finish=finish,
    reads=find_recorded,
    normalize=normalize,
    modules=(
        "pipeline.stages.batch_memory",
        "pipeline.stages.calibration",
        "pipeline.stages.devices",
        "pipeline.stages.recorded",
        "pipeline.stages.simulation",
        "pipeline.stages.rollout",
        "pipeline.storage.rollouts",
    ),
)
