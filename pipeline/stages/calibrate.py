"""Stage ``calibrate``: weights to what rollouts add to their odds of coming and going.

Odds that are right token step by token step thin a street out, or fill it, once the
network plays on its own. So a unit plays some scenes with one pair of biases and counts who
came, went and was there, beside their logs; ``finish`` finds the pair with which both are
alike. Where the last validation of the training is to decide, there are no units.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.clock import CLOCK
from infgen.config import CalibrateSettings, RolloutSettings, TokenSettings
from pipeline.engine.stage import FinishedUnit, Inputs, Progress, Report, Stage, Unit
from pipeline.stages.batch_memory import BatchSize
from pipeline.stages.calibration import Biases, read_biases, write_found
from pipeline.stages.devices import decide_device, device_of_units, on_device
from pipeline.stages.simulation import (
    about_run,
    begin,
    load_simulator,
    read_some,
    simulate_all,
)
from pipeline.storage.splits import files_of_split, spread_evenly

if TYPE_CHECKING:
    from infgen.metrics.flow import FlowCounts

Settings = Mapping[str, Any]


def normalize(settings: Settings) -> Settings:
    """Leave only what decides: rollouts that differ in the rest share a calibration."""
    how: CalibrateSettings = settings["calibrate"]
    played: RolloutSettings = settings["rollout"]
    if how.method != "simulate" or not (played.inserts and played.removes):
        return {
            "tokenize": TokenSettings(),
            "rollout": RolloutSettings(),
            "calibrate": CalibrateSettings(
                method="none" if how.method == "none" else "odds"
            ),
        }
    usual = RolloutSettings()
    same = (
        "split",
        "max_scenes",
        "scenes_per_unit",
        "batch_rollouts",
        "add_bias",
        "remove_bias",
        "seed",
    )
    rest = {name: getattr(usual, name) for name in same}
    return {**settings, "rollout": replace(played, count=1, **rest)}


def plan(inputs: Inputs, settings: Settings) -> list[Unit]:
    """One unit per pair of biases and some scenes; none if nothing is simulated."""
    how: CalibrateSettings = settings["calibrate"]
    if how.method != "simulate":
        return []
    from pipeline.stages.flow_response import DESIGN  # noqa: PLC0415

    weights = inputs.folder("train")
    identity = inputs.content("train", "model.safetensors", "model.json")
    reach = _reach(weights, how)
    units, device = [], decide_device(settings["rollout"])
    for point, (add, leave) in enumerate(DESIGN):
        biases = asdict(reach.at(add, leave))
        for part, pieces in enumerate(_parts(inputs, how)):
            units.append(
                Unit(
                    name=f"biases-{point}-{part:03d}",
                    inputs={
                        "weights": identity,
                        **{f"scenes/{done.name}": done.key for done, *_ in pieces},
                    },
                    task={
                        "weights": str(weights),
                        "biases": biases,
                        "device": device,
                        "point": point,
                        "pieces": [
                            {"scenes": str(done.path), "rows": rows}
                            for done, rows in pieces
                        ],
                    },
                )
            )
    return units


def _reach(weights: Path, how: CalibrateSettings) -> Any:
    from pipeline.stages.flow_response import Reach  # noqa: PLC0415

    return Reach(read_biases(weights), how.add_bias_range, how.remove_bias_range)


def _parts(
    inputs: Inputs, how: CalibrateSettings
) -> list[list[tuple[FinishedUnit, list[int]]]]:
    """Cut the scenes into parts for one unit each: file, rows of its scenes.

    Raises:
        PlanError: if there is no scene of the split.
    """
    files = files_of_split(
        inputs.units("ingest"), how.split,
        to="simulate for calibration", setting="calibrate.split or calibrate.method",
    )  # fmt: skip
    chosen = zip(files, spread_evenly(files, how.max_scenes), strict=True)
    scenes = [(done, row) for done, rows in chosen for row in rows]
    most = how.scenes_per_unit
    parts = [scenes[at : at + most] for at in range(0, len(scenes), most)]
    return [
        [(done, [row for _, row in some]) for done, some in groupby(part, itemgetter(0))]
        for part in parts
    ]


def work(unit: Unit, target: Path, settings: Settings, progress: Progress) -> Report:
    """Simulate some scenes with one pair of biases; count them, and their logs."""
    from infgen.metrics.flow import add_up, count_flow  # noqa: PLC0415
    from infgen.metrics.traffic import from_log, from_rollout, on_map  # noqa: PLC0415
    from infgen.rollout.rules.off_road import lane_segments  # noqa: PLC0415

    target.mkdir(parents=True, exist_ok=True)
    how: CalibrateSettings = settings["calibrate"]
    played = on_device(
        Biases(**unit.task["biases"]).over(settings["rollout"]), unit.task["device"]
    )
    folder, identity = Path(unit.task["weights"]), unit.inputs["weights"]
    simulator, weights = load_simulator(folder, identity, played)
    starts, played_on, logs, refused = [], [], [], []
    longest = CLOCK.tokens_in(simulator.settings.duration_s)
    for scene in _scenes(unit):
        try:
            logged = from_log(scene, settings["tokenize"])
            starts += begin(simulator, scene)
        except ValueError as error:
            refused.append(f"{scene.scenario_id}: {error}")
            continue
        # The longer of a log and its rollouts is cut into windows as long as the shorter.
        played_on.append((min(longest, logged.future_tokens), lane_segments(scene)))
        logs.append(count_flow(logged, how.count_radius_m, longest))

    def tell(done: float) -> None:
        progress(done, len(starts), "rollouts")

    size = BatchSize(played.batch_rollouts)
    # One rollout a scene: batches of one scene each would cost far more, for counts alone.
    groups = simulate_all(simulator, starts, weights, tell, size, mix_scenes=True)
    rollouts = chain.from_iterable(groups)
    # Beyond the end of a map no agent enters: biases must not compensate for that.
    plays = [
        count_flow(on_map(from_rollout(rollout), lanes), how.count_radius_m, length)
        for rollout, (length, lanes) in zip(rollouts, played_on, strict=True)
    ]
    return {
        "point": unit.task["point"],
        "scenes": len(starts),
        "played": asdict(add_up(plays)),
        "logged": asdict(add_up(logs)),
        "refused": refused,
        "device": played.device,
        "run": about_run(simulator, size),
    }


def _scenes(unit: Unit) -> Iterator[Any]:
    for piece in unit.task["pieces"]:
        yield from read_some(Path(piece["scenes"]), piece["rows"])


def finish(
    inputs: Inputs,
    units: Sequence[FinishedUnit],
    target: Path,
    settings: Settings,
    progress: Progress,
) -> Report:
    """Find the biases, and write them with the counts behind them."""
    target.mkdir(parents=True, exist_ok=True)
    how: CalibrateSettings = settings["calibrate"]
    odds = Biases() if how.method == "none" else read_biases(inputs.folder("train"))
    found, about = odds, {"method": how.method}
    if units:
        found, about = _find(inputs, units, target, how)
    write_found(target, found)
    return {"add_bias": found.add, "remove_bias": found.leave, **about}


def _find(
    inputs: Inputs, units: Sequence[FinishedUnit], target: Path, how: CalibrateSettings
) -> tuple[Biases, Report]:
    """Find the biases from the simulations, and say how sure they are."""
    from pipeline.engine.atomic import write_json  # noqa: PLC0415
    from pipeline.stages.flow_response import DESIGN, find_best  # noqa: PLC0415

    reach = _reach(inputs.folder("train"), how)
    plays = [_sum(units, "played", point) for point in range(len(DESIGN))]
    logs = _sum(units, "logged", 0)
    lines = [
        {**asdict(reach.at(*point)), **_rates(play)}
        for point, play in zip(DESIGN, plays, strict=True)
    ]
    write_json(target / "plays.json", {"logs": _rates(logs), "plays": lines})
    refused = sorted({line for done in units for line in done.report["refused"]})
    scenes = sum(done.report["scenes"] for done in units if done.report["point"] == 0)
    about: Report = {
        "scenes": scenes,
        "refused": refused,
        "device": device_of_units(units),
    }
    best = find_best(plays, logs, reach)
    if best is None:
        # No insertions, or too few to decide.
        return reach.around, {**about, "method": "odds"}
    return best.biases, {
        "method": "simulate",
        "came_expected": best.came,
        "went_expected": best.went,
        "agents_expected": best.agents,
        "at_the_end_of_reach": best.at_the_end,
        **about,
    }


def _sum(units: Sequence[FinishedUnit], what: str, point: int) -> "FlowCounts":
    from infgen.metrics.flow import FlowCounts, add_up  # noqa: PLC0415

    return add_up(
        FlowCounts(**done.report[what]) for done in units if done.report["point"] == point
    )


def _rates(counts: "FlowCounts") -> dict[str, float | None]:
    """Rates as they are written: None where nothing was looked at."""
    found = {
        "came_per_token": counts.came,
        "went_per_token": counts.went,
        "agents": counts.agents,
    }
    return {
        name: round(counts.per_token(count), 4) if counts.tokens else None
        for name, count in found.items()
    }


STAGE = Stage(
    name="calibrate",
    version=13,
    settings={
        "tokenize": TokenSettings,
        "rollout": RolloutSettings,
        "calibrate": CalibrateSettings,
    },
    plan=plan,
    work=work,
    finish=finish,
    normalize=normalize,
    modules=(
        "pipeline.stages.batch_memory",
        "pipeline.stages.calibrate",
        "pipeline.stages.calibration",
        "pipeline.stages.devices",
        "pipeline.stages.simulation",
        "pipeline.stages.flow_response",
    ),
)
