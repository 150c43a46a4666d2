"""Tasks for workers from units of a stage, and the manifests of units and stages."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from pipeline.engine.code_hash import code_hash
from pipeline.engine.layout import STAGE_SCHEMA, UNIT_SCHEMA, Root
from pipeline.engine.manifest import package_versions, read_manifest
from pipeline.engine.plan import PlanError, PlannedStage, without_locations
from pipeline.engine.stage import Unit
from pipeline.engine.units import Task


def make_tasks(root: Root, planned: PlannedStage, units: Sequence[Unit]) -> list[Task]:
    """Give every unit its folder and its manifest without the report.

    Raises:
        PlanError: if two units have one name, or a name is no file name.
    """
    for name, count in Counter(unit.name for unit in units).items():
        if count > 1 or "/" in name or not name:
            raise PlanError(
                f"stage {planned.name!r} has a unit with a bad or repeated name {name!r}"
            )
    common = _common(planned)
    return [_task(root, planned, unit, common) for unit in units]


def _task(root: Root, planned: PlannedStage, unit: Unit, common: dict[str, Any]) -> Task:
    key = planned.unit_key(unit)
    about = {
        "schema": UNIT_SCHEMA,
        **common,
        "name": unit.name,
        "key": key,
        "inputs": dict(unit.inputs),
        "task": without_locations(unit.task),
    }
    target = root.unit(planned.name, key)
    return Task(planned.module, unit, target, planned.settings, about)


def stage_manifest(planned: PlannedStage, tasks: Sequence[Task]) -> dict[str, Any]:
    """Build the manifest of a stage whose units are all made, without its own report."""
    ordered = sorted(tasks, key=lambda task: task.unit.name)
    return {
        "schema": STAGE_SCHEMA,
        **_common(planned),
        "key": planned.key,
        "inputs": dict(planned.inputs),
        "sources": {source.name: source.fingerprint for source in planned.sources},
        "units": [_unit_entry(task) for task in ordered],
    }


def _common(planned: PlannedStage) -> dict[str, Any]:
    """Entries that the manifests of a stage and of its units share."""
    stage = planned.stage
    return {
        "stage": stage.name,
        "version": stage.version,
        "settings": planned.values,
        "code": code_hash(stage.modules),
        "packages": package_versions(),
    }


def _unit_entry(task: Task) -> dict[str, Any]:
    report = read_manifest(task.target)["report"]
    return {"name": task.unit.name, "key": task.about["key"], "report": report}
