"""Stage ``score``: rollouts to a table of scores, against the reference of their split.

A unit scores the rollouts of one rollout unit, window by window and by the official
metric, or the logs of one file of the split as if they were rollouts; ``finish`` only joins
what the units wrote.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import groupby
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.config import ReferenceSettings, ScoreSettings
from infgen.errors import ConfigError
from pipeline.engine.stage import FinishedUnit, Inputs, Progress, Report, Stage, Unit
from pipeline.storage.splits import in_split, split_of

if TYPE_CHECKING:
    from infgen.metrics.long_term.binned import Binned
    from infgen.metrics.long_term.reference import Counts
    from infgen.metrics.long_term.table import Against, Row
    from infgen.metrics.proper.retrieval import LogCourse
    from infgen.metrics.traffic import Traffic
    from infgen.rollout.rollout import Rollout
    from infgen.scene import Scene
    from infgen.spatial.road_edges import RoadEdges
    from pipeline.stages.score.proper import SceneEnsemble
    from pipeline.stages.score.write import ScoreRow


def plan(inputs: Inputs, settings: Mapping[str, Any]) -> list[Unit]:
    """One unit per file of logs, and one per rollout unit.

    Raises:
        ConfigError: if the rollouts are not of the reference's split, or if there is no
            such version of Waymo's metric.
    """
    from infgen.metrics.wosac.versions import VERSIONS  # noqa: PLC0415

    if (version := settings["score"].wosac_version) not in VERSIONS:
        raise ConfigError(
            f"score.wosac_version is {version!r}; expected one of {', '.join(VERSIONS)}"
        )
    _check_split(inputs.units("rollout"), settings["reference"].split)
    scenes = {done.name: done for done in inputs.units("ingest")}
    logs = {done.name: done for done in inputs.units("reference")}
    identity = inputs.content("reference", "counts.zarr", "means.json", "courses.zarr")
    folder = str(inputs.folder("reference"))
    units = [
        Unit(
            done.name,
            {"logs": done.key, "reference": identity},
            {"logs": str(done.path), "reference": folder},
        )
        for done in logs.values()
    ]
    for done in inputs.units("rollout"):
        source = done.name.rsplit("-", 1)[0]
        reads = {"rollouts": done, "scenes": scenes.get(source), "logs": logs.get(source)}
        keys = {name: one.key if one else "" for name, one in reads.items()}
        paths = {name: str(one.path) if one else "" for name, one in reads.items()}
        units.append(
            Unit(
                done.name,
                {**keys, "reference": identity},
                {**paths, "reference": folder},
            )
        )
    return units


def _check_split(rollouts: Sequence[FinishedUnit], split: str) -> None:
    for done in rollouts:
        if not in_split(done.name, split):
            found = split_of(done.name)
            raise ConfigError(
                f"the rollouts are of split {found!r}, the reference of {split!r}; set "
                f"reference.split={found}"
            )


def work(
    unit: Unit, target: Path, settings: Mapping[str, Any], progress: Progress
) -> Report:
    """Score all rollouts of some scenes, or some logs."""
    target.mkdir(parents=True, exist_ok=True)
    if "rollouts" in unit.task:
        return _score_rollouts(unit, target, settings, progress)
    from pipeline.stages.score.logs import score_logs  # noqa: PLC0415

    logs, reference = Path(unit.task["logs"]), Path(unit.task["reference"])
    return {"logs": score_logs(logs, reference, target, settings["reference"])}


def _score_rollouts(
    unit: Unit, target: Path, settings: Mapping[str, Any], progress: Progress
) -> Report:
    from pipeline.engine.atomic import write_json  # noqa: PLC0415
    from pipeline.stages.reference_files import (  # noqa: PLC0415
        read_against,
        read_courses,
        read_logged,
        write_counts,
    )
    from pipeline.stages.score.proper import write_proper  # noqa: PLC0415
    from pipeline.stages.score.tables import WOSAC  # noqa: PLC0415
    from pipeline.stages.score.write import ROWS, write_part, write_tally  # noqa: PLC0415
    from pipeline.storage.rollouts import read_lights, read_rollouts  # noqa: PLC0415

    folder, logs = Path(unit.task["rollouts"]), unit.task["logs"]
    logged = read_logged(Path(logs)) if logs else {}
    against = read_against(Path(unit.task["reference"]), logged, settings["reference"])
    wanted = _scenario_ids(folder)
    scenes = dict(_scenes(unit.task["scenes"], wanted))
    courses = read_courses(Path(unit.task["reference"]))
    scorer = _Scorer(against, courses, read_lights(folder) == "log", settings)
    grouped = groupby(read_rollouts(folder), key=lambda rollout: rollout.scenario_id)
    for scenario_id, group in grouped:
        if scenario_id in scenes:
            scorer.take(scenes[scenario_id], list(group))
            progress(len(scorer.official), len(wanted), "scenes")
    scorer.tally.close_unit()
    write_part(target / ROWS, scorer.rows())
    write_tally(target, scorer.tally)
    write_proper(target, scorer.proper)
    write_counts(target, scorer.counts)
    write_json(target / WOSAC, scorer.official)
    missing = [scenario_id for scenario_id in wanted if scenario_id not in scenes]
    return {
        "scenes": len(scorer.official),
        "rollouts": scorer.tally.rollouts,
        "missing": missing,
    }


class _Scorer:
    """The scores of one unit, taken scene by scene."""

    def __init__(
        self,
        against: "Against",
        courses: "Sequence[LogCourse]",
        logged_lights: bool,
        settings: Mapping[str, Any],
    ) -> None:
        from infgen.metrics.long_term.reference import no_counts  # noqa: PLC0415
        from pipeline.stages.score.proper import ProperTally  # noqa: PLC0415
        from pipeline.stages.score.summary import Tally  # noqa: PLC0415

        self.tally: Tally = Tally()
        self.counts: Counts = no_counts()
        self.official: list[dict[str, Any]] = []
        self.proper: ProperTally = ProperTally()
        self._against, self._courses = against, courses
        self._logged_lights = logged_lights
        self._reference: ReferenceSettings = settings["reference"]
        self._settings: ScoreSettings = settings["score"]
        self._rows: list[ScoreRow] = []

    def take(self, scene: "Scene", rollouts: "Sequence[Rollout]") -> None:
        """Score the rollouts of one scene."""
        from infgen.metrics.long_term.reference import count_simulated  # noqa: PLC0415
        from infgen.metrics.long_term.table import make_row  # noqa: PLC0415
        from infgen.spatial.road_edges import scene_road_edges  # noqa: PLC0415
        from pipeline.stages.score.write import rows_of  # noqa: PLC0415

        edges, radius_m = scene_road_edges(scene), self._settings.presence_radius_m
        self.official.append(_score_wosac(scene, rollouts, self._settings.wosac_version))
        ensemble = self._gather(scene, edges, rollouts)
        for rollout in rollouts:
            lived, traffic, binned = measure_rollout(
                rollout, edges, self._reference, radius_m
            )
            row = make_row(binned, self._against)
            if ensemble is not None:
                ensemble.add(traffic, binned, lived)
            windows = self._against.windows(binned.bins.shape[-1])
            self.counts += count_simulated(binned, windows)
            self.tally.add(scene.scenario_id, row)
            self._rows += rows_of(scene.scenario_id, rollout.index, row.numbers, "")

        proper = None if ensemble is None else ensemble.score(self._courses)
        if proper is not None:
            self.proper.add(scene.scenario_id, proper)

    def _gather(
        self, scene: "Scene", edges: "RoadEdges | None", rollouts: "Sequence[Rollout]"
    ) -> "SceneEnsemble | None":
        """Begin to gather rollouts for protocol ``proper``, if it is asked for."""
        from pipeline.stages.score.proper import SceneEnsemble  # noqa: PLC0415

        if not self._settings.proper:
            return None
        lights = self._logged_lights
        return SceneEnsemble(scene, edges, rollouts, self._reference, logged_lights=lights)

    def rows(self) -> "list[ScoreRow]":
        """Rows of the rollouts, of protocol ``proper``, and of the official metric."""
        from pipeline.stages.score.proper import proper_numbers  # noqa: PLC0415
        from pipeline.stages.score.write import rows_of  # noqa: PLC0415

        found = list(self._rows)
        for scenario_id, parts in self.proper.parts.items():
            found += rows_of(scenario_id, None, proper_numbers(parts), "")
        for one in self.official:
            prefix = f"{self._settings.wosac_version}/"
            scores = one.get("scores", {})
            measured = {k: value for k, value in scores.items() if value is not None}
            found += rows_of(one["scenario_id"], None, measured, prefix)
        return found


def score_rollout(
    rollout: "Rollout",
    edges: "RoadEdges | None",
    against: "Against",
    reference: ReferenceSettings,
    presence_radius_m: float,
) -> "tuple[Binned, Row]":
    """Measure one rollout, and score it under the long-term protocols.

    Args:
        rollout: The rollout.
        edges: Road edges of its scene.
        against: The logs of a split.
        reference: How those were measured.
        presence_radius_m: Agents are present within it only; 0 for no limit.
    """
    from infgen.metrics.long_term.table import make_row  # noqa: PLC0415

    _, _, binned = measure_rollout(rollout, edges, reference, presence_radius_m)
    return binned, make_row(binned, against)


def measure_rollout(
    rollout: "Rollout",
    edges: "RoadEdges | None",
    reference: ReferenceSettings,
    presence_radius_m: float,
) -> "tuple[Rollout, Traffic, Binned]":
    """Return a rollout as far as its agents are present, its traffic, and its features.

    Args:
        rollout: The rollout.
        edges: Road edges of its scene.
        reference: How logs are measured.
        presence_radius_m: Agents are present within it only; 0 for no limit.
    """
    from infgen.metrics.long_term.binned import bin_traffic  # noqa: PLC0415
    from infgen.metrics.long_term.radius import present_within_radius  # noqa: PLC0415
    from infgen.metrics.traffic import from_rollout  # noqa: PLC0415

    if presence_radius_m:
        rollout = present_within_radius(rollout, presence_radius_m)
    traffic = from_rollout(rollout)
    binned = bin_traffic(traffic, edges, reference.count_radius_m, as_logged=False)
    return rollout, traffic, binned


def _score_wosac(
    scene: "Scene", rollouts: "Sequence[Rollout]", version: str
) -> dict[str, Any]:
    """Official scores of one scene, null what is not measured, or why there are none."""
    from infgen.metrics.wosac import metric  # noqa: PLC0415

    found: dict[str, Any] = {"scenario_id": scene.scenario_id}
    try:
        log = metric.from_scene(scene)
        scores = metric.score(log, metric.from_rollouts(rollouts), version)
    except ValueError as error:
        return {**found, "skipped": str(error)}
    numbers = scores.numbers()
    plain = {name: None if isnan(value) else value for name, value in numbers.items()}
    return {**found, "scores": plain}


def _scenario_ids(folder: Path) -> list[str]:
    """Scenes of a rollout unit, in its order."""
    import polars as pl  # noqa: PLC0415

    column = pl.read_parquet(folder / "index.parquet", columns=["scenario_id"])
    return list(dict.fromkeys(column["scenario_id"].to_list()))


def _scenes(folder: str, wanted: Sequence[str]) -> "Iterator[tuple[str, Scene]]":
    """Find scenes of an ingested file by id; stops with the last of them."""
    from pipeline.storage.scenes import read_scenes  # noqa: PLC0415

    left = set(wanted)
    for scene in read_scenes(Path(folder)) if folder else ():
        if scene.scenario_id in left:
            left.remove(scene.scenario_id)
            yield scene.scenario_id, scene
        if not left:
            return


def finish(
    inputs: Inputs,
    units: Sequence[FinishedUnit],
    target: Path,
    settings: Mapping[str, Any],
    progress: Progress,
) -> Report:
    """Join the units' scores; write tables, curves and the summary."""
    from pipeline.stages.score.tables import gather  # noqa: PLC0415

    target.mkdir(parents=True, exist_ok=True)
    return asdict(gather(inputs, units, target, settings, progress))


STAGE = Stage(
    name="score",
    version=6,
    settings={"reference": ReferenceSettings, "score": ScoreSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=(
        "pipeline.stages.reference_files",
        "pipeline.stages.score.gathered",
        "pipeline.stages.score.logs",
        "pipeline.stages.score.stage",
        "pipeline.stages.score.proper",
        "pipeline.stages.score.proper_summary",
        "pipeline.stages.score.summary",
        "pipeline.stages.score.tables",
        "pipeline.stages.score.write",
    ),
)
