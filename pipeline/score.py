"""Stage ``score``: rollouts and the logs of their split to a table of scores.

Two kinds of unit, neither of which needs another: a *reference* unit measures the logs of
one ingested file, a rollout unit measures rollouts and scores the official metric. Both
keep bins (``infgen.metrics.binned``); ``finish`` adds up the logged counts of the split and
scores the bins under them.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.config import ScoreSettings, TokenSettings
from pipeline.splits import split_of
from pipeline.stage import Done, Inputs, Progress, Report, Stage, Unit

if TYPE_CHECKING:
    from infgen.metrics.binned import Binned
    from infgen.metrics.reference import Counts
    from infgen.metrics.windows import Windows
    from infgen.rollout.rollout import Rollout
    from infgen.scene import Scene

BINNED_SCHEMA, COUNTS_SCHEMA = "infgen.binned/1", "infgen.counts/1"
SCENES_PER_GROUP = 64
REFERENCE = "reference"


def plan(inputs: Inputs, settings: Mapping[str, Any]) -> list[Unit]:
    """One unit per log file of the rollouts' split, and one per rollout unit."""
    rollouts = inputs.units("rollout")
    logs = {done.name: done for done in inputs.units("ingest")}
    splits = {split_of(done.name) for done in rollouts}
    units = [
        Unit(f"{REFERENCE}-{name}", {"scenes": done.key}, {"scenes": str(done.path)})
        for name, done in logs.items()
        if split_of(name) in splits
    ]
    for done in rollouts:
        log = logs.get(done.name.rsplit("-", 1)[0])
        units.append(
            Unit(
                done.name,
                {"rollouts": done.key, "scenes": log.key if log else ""},
                {"rollouts": str(done.path), "scenes": str(log.path) if log else ""},
            )
        )
    return units


def work(
    unit: Unit, target: Path, settings: Mapping[str, Any], progress: Progress
) -> Report:
    """Measure the logs of one file, or the rollouts of one unit."""
    target.mkdir(parents=True, exist_ok=True)
    if "rollouts" in unit.task:
        return _measure_rollouts(unit, target, settings["score"], progress)
    return _measure_logs(unit, target, settings, progress)


def _measure_logs(
    unit: Unit, target: Path, settings: Mapping[str, Any], progress: Progress
) -> Report:
    """Count the logs for the reference, and bin them as if they were rollouts."""
    from infgen.metrics.reference import no_counts  # noqa: PLC0415
    from pipeline.ingest import read_scenes  # noqa: PLC0415

    score: ScoreSettings = settings["score"]
    counts = no_counts()
    group: list[Binned] = []
    skipped: dict[str, str] = {}
    scenes = groups = 0
    for scene in read_scenes(Path(unit.task["scenes"])):
        measured = _measure_log(scene, settings["tokenize"], score)
        if isinstance(measured, str):
            skipped[scene.scenario_id] = measured
            continue
        counts += measured[0]
        group.append(measured[1])
        scenes += 1
        progress(scenes, scenes, "logs")
        if len(group) == SCENES_PER_GROUP:
            _write_binned(target, groups, group)
            group, groups = [], groups + 1
    _write_binned(target, groups, group)
    _write_counts(target, counts)
    return {"kind": REFERENCE, "scenes": scenes, "skipped": skipped}


def _measure_log(
    scene: "Scene", tokens: TokenSettings, settings: ScoreSettings
) -> "tuple[Counts, Binned] | str":
    """Count one log, and bin it; or say why it cannot be."""
    from infgen.metrics.binned import bin_traffic, edges_of  # noqa: PLC0415
    from infgen.metrics.reference import count_log  # noqa: PLC0415
    from infgen.metrics.traffic import from_log  # noqa: PLC0415

    windows = _windows(scene.tracks.num_steps - scene.now - 1, settings)
    if not windows.count:
        return f"{scene.tracks.num_steps} steps hold no window of {settings.window_s:g} s"
    try:
        traffic = from_log(scene, tokens)
    except ValueError as error:
        return str(error)
    edges, radius_m = edges_of(scene), settings.count_radius_m
    logged = bin_traffic(traffic, edges, radius_m, as_logged=True)
    played = bin_traffic(traffic, edges, radius_m, as_logged=False)
    return count_log(logged, windows), played


def _measure_rollouts(
    unit: Unit, target: Path, settings: ScoreSettings, progress: Progress
) -> Report:
    """Bin all rollouts of some scenes, and score each scene by the official metric."""
    from infgen.metrics.binned import bin_traffic, edges_of  # noqa: PLC0415
    from infgen.metrics.radius import live_within  # noqa: PLC0415
    from infgen.metrics.reference import count_simulated, no_counts  # noqa: PLC0415
    from infgen.metrics.traffic import from_rollout  # noqa: PLC0415
    from pipeline.folders import write_json  # noqa: PLC0415
    from pipeline.rollout import read_rollouts  # noqa: PLC0415

    folder = Path(unit.task["rollouts"])
    wanted = _scenario_ids(folder)
    scenes = dict(_scenes(unit.task["scenes"], wanted))
    counts, wosac = no_counts(), []
    number = 0
    grouped = groupby(read_rollouts(folder), key=lambda rollout: rollout.scenario_id)
    for scenario_id, group in grouped:
        if scenario_id not in scenes:
            continue
        scene, rollouts = scenes[scenario_id], list(group)
        edges = edges_of(scene)
        wosac.append(_score_wosac(scene, rollouts, settings.wosac))
        binned = []
        for rollout in rollouts:
            lived = rollout
            if settings.enter_radius_m:
                lived = live_within(rollout, settings.enter_radius_m)
            traffic = from_rollout(lived)
            one = bin_traffic(traffic, edges, settings.count_radius_m, as_logged=False)
            counts += count_simulated(one, _windows(one.bins.shape[-1], settings))
            binned.append(one)
        _write_binned(target, number, binned)
        number += 1
        progress(number, len(wanted), "scenes")
    _write_counts(target, counts)
    write_json(target / "wosac.json", wosac)
    missing = [scenario_id for scenario_id in wanted if scenario_id not in scenes]
    return {"kind": "rollouts", "scenes": number, "missing": missing}


def _score_wosac(
    scene: "Scene", rollouts: "Sequence[Rollout]", version: str
) -> dict[str, Any]:
    """Official scores of one scene, or why there are none."""
    from infgen.metrics import wosac  # noqa: PLC0415

    found: dict[str, Any] = {"scenario_id": scene.scenario_id}
    try:
        log = wosac.from_scene(scene)
        scores = wosac.score(log, wosac.from_rollouts(rollouts), version)
    except ValueError as error:
        return {**found, "skipped": str(error)}
    return {**found, "scores": scores.numbers()}


def _scenario_ids(folder: Path) -> list[str]:
    """Scenes of a rollout unit, in its order."""
    import polars as pl  # noqa: PLC0415

    column = pl.read_parquet(folder / "index.parquet", columns=["scenario_id"])
    return list(dict.fromkeys(column["scenario_id"].to_list()))


def _scenes(folder: str, wanted: Sequence[str]) -> "Iterator[tuple[str, Scene]]":
    """Find scenes of an ingested file by id; stops with the last of them."""
    from pipeline.ingest import read_scenes  # noqa: PLC0415

    left = set(wanted)
    for scene in read_scenes(Path(folder)) if folder else ():
        if scene.scenario_id in left:
            left.remove(scene.scenario_id)
            yield scene.scenario_id, scene
        if not left:
            return


def _windows(num_steps: int, settings: ScoreSettings) -> "Windows":
    from infgen.metrics.windows import cut_windows  # noqa: PLC0415

    return cut_windows(num_steps, settings.window_s, settings.stride_s)


def _write_binned(target: Path, number: int, binned: "Sequence[Binned]") -> None:
    from infgen.metrics.binned import Binned  # noqa: PLC0415
    from pipeline.store import write_records  # noqa: PLC0415

    if binned:
        path = target / f"binned-{number:03d}.zarr"
        write_records(path, binned, Binned, BINNED_SCHEMA, compress=True)


def _write_counts(target: Path, counts: "Counts") -> None:
    from infgen.metrics.reference import Counts  # noqa: PLC0415
    from pipeline.store import write_records  # noqa: PLC0415

    path = target / "counts.zarr"
    write_records(path, [counts], Counts, COUNTS_SCHEMA, compress=True)


def read_binned(folder: Path) -> "Iterator[Binned]":
    """Read the bins of one unit, a group in memory at a time."""
    from infgen.metrics.binned import Binned  # noqa: PLC0415
    from pipeline.store import read_records  # noqa: PLC0415

    for path in sorted(folder.glob("binned-*.zarr")):
        yield from read_records(path, Binned, BINNED_SCHEMA, mapped=False)


def read_counts(folder: Path) -> "Counts":
    """Read the counts of one unit."""
    from infgen.metrics.reference import Counts  # noqa: PLC0415
    from pipeline.store import read_records  # noqa: PLC0415

    return read_records(folder / "counts.zarr", Counts, COUNTS_SCHEMA, mapped=False)[0]


def finish(
    inputs: Inputs,
    units: Sequence[Done],
    target: Path,
    settings: Mapping[str, Any],
    progress: Progress,
) -> Report:
    """Score all bins under the split's counts; write tables, curves and the summary."""
    from pipeline.score_tables import gather  # noqa: PLC0415

    target.mkdir(parents=True, exist_ok=True)
    return asdict(gather(units, target, settings["score"], progress))


STAGE = Stage(
    name="score",
    version=1,
    settings={"tokenize": TokenSettings, "score": ScoreSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=("infgen.metrics", "pipeline.score", "pipeline.score_tables"),
)
