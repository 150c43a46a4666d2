"""Stage ``reference``: the logs of a split to what rollouts are scored against.

A unit counts the logs of one ingested file and keeps their bins; ``finish`` adds the counts
up. Stage ``score`` scores the logs themselves under them: the ceiling for any rollout.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.config import ReferenceSettings, TokenSettings
from pipeline.engine.stage import FinishedUnit, Inputs, Progress, Report, Stage, Unit
from pipeline.storage.duplicates import read_task_scenes, scenes_task
from pipeline.storage.splits import files_of_split

if TYPE_CHECKING:
    from infgen.metrics.long_term.binned import Binned
    from infgen.metrics.long_term.reference import Counts
    from infgen.metrics.proper.retrieval import LogCourse
    from infgen.scene import Scene

SCENES_PER_GROUP = 64


def plan(inputs: Inputs, settings: Mapping[str, Any]) -> list[Unit]:
    """One unit per ingested file of the split.

    Raises:
        PlanError: if there is no scene of the split.
    """
    every, split = inputs.units("ingest"), settings["reference"].split
    files = files_of_split(every, split, to="measure", setting="reference.split")
    return [Unit(done.name, {"scenes": done.key}, scenes_task(done)) for done in files]


def work(
    unit: Unit, target: Path, settings: Mapping[str, Any], progress: Progress
) -> Report:
    """Count the logs of one file, and bin them as if they were rollouts."""
    from infgen.metrics.long_term.reference import no_counts  # noqa: PLC0415
    from infgen.metrics.long_term.table import LogCounts  # noqa: PLC0415
    from pipeline.stages import reference_files as files  # noqa: PLC0415

    target.mkdir(parents=True, exist_ok=True)
    counts, logged, courses = no_counts(), [], []
    group: list[Binned] = []
    skipped: dict[str, str] = {}
    for scene in read_task_scenes(unit.task):
        measured = measure_log(scene, settings["tokenize"], settings["reference"])
        if isinstance(measured, str):
            skipped[scene.scenario_id] = measured
            continue
        counts += measured[0]
        binned = measured[1]
        courses.append(measured[2])
        group.append(binned)
        numbers = LogCounts(binned.num_near, binned.num_all)
        logged.append(files.Logged(scene.scenario_id, numbers))
        progress(len(logged), len(logged), "logs")
        if len(group) == SCENES_PER_GROUP:
            files.write_binned(target, len(logged), group)
            group = []
    files.write_binned(target, len(logged), group)
    files.write_counts(target, counts)
    files.write_logged(target, logged)
    files.write_courses(target, courses)
    return {"scenes": len(logged), "skipped": skipped}


def measure_log(
    scene: "Scene", tokens: TokenSettings, settings: ReferenceSettings
) -> "tuple[Counts, Binned, LogCourse] | str":
    """Count one log, bin it and follow its course; or say why it cannot be."""
    from infgen.metrics.long_term.binned import bin_traffic  # noqa: PLC0415
    from infgen.metrics.long_term.reference import count_log  # noqa: PLC0415
    from infgen.metrics.proper.context import read_context  # noqa: PLC0415
    from infgen.metrics.proper.course import follow_course  # noqa: PLC0415
    from infgen.metrics.proper.retrieval import LogCourse  # noqa: PLC0415
    from infgen.metrics.traffic import from_log  # noqa: PLC0415
    from infgen.metrics.windows import cut_windows  # noqa: PLC0415
    from infgen.spatial.road_edges import scene_road_edges  # noqa: PLC0415

    after = scene.tracks.num_steps - scene.now - 1
    windows = cut_windows(after, settings.window_s, settings.stride_s)
    if not windows.count:
        return f"{scene.tracks.num_steps} steps hold no window of {settings.window_s:g} s"
    try:
        traffic = from_log(scene, tokens)
    except ValueError as error:
        return str(error)
    edges, radius_m = scene_road_edges(scene), settings.count_radius_m
    logged = bin_traffic(traffic, edges, radius_m, as_logged=True)
    played = bin_traffic(traffic, edges, radius_m, as_logged=False)
    side_by_side = cut_windows(after, settings.proper_window_s, settings.proper_window_s)
    course = LogCourse(
        scenario_id=scene.scenario_id,
        context=read_context(scene, traffic, radius_m),
        course=follow_course(traffic, radius_m, side_by_side),
    )
    return count_log(logged, windows), played, course


def finish(
    inputs: Inputs,
    units: Sequence[FinishedUnit],
    target: Path,
    settings: Mapping[str, Any],
    progress: Progress,
) -> Report:
    """Add up the counts of the split."""
    from pipeline.stages.reference_tables import gather  # noqa: PLC0415

    target.mkdir(parents=True, exist_ok=True)
    gather([done.path for done in units], target, settings["reference"])
    return {
        "logs": sum(done.report["scenes"] for done in units),
        "skipped": sum(len(done.report["skipped"]) for done in units),
    }


STAGE = Stage(
    name="reference",
    version=5,
    settings={"tokenize": TokenSettings, "reference": ReferenceSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=(
        "pipeline.storage.duplicates",
        "pipeline.stages.reference",
        "pipeline.stages.reference_files",
        "pipeline.stages.reference_tables",
    ),
)
