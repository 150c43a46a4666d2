"""Finished units and folders of the stages that a stage reads."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.engine.layout import Root
from pipeline.engine.manifest import read_manifest
from pipeline.engine.plan import Plan, PlanError, PlannedStage, digest
from pipeline.engine.stage import FinishedUnit, Source


@dataclass(frozen=True, slots=True)
class FinishedInputs:
    """The ``Inputs`` of one stage. Reading a stage that is not in its deps is an error."""

    root: Root
    planned: PlannedStage

    @property
    def sources(self) -> Sequence[Source]:
        """Source files, by name; none if ``sources`` is not among the stage's deps."""
        return self.planned.sources

    def key(self, stage: str) -> str:
        """Key of an input stage.

        Raises:
            PlanError: if it is not among the stage's deps.
        """
        if stage not in self.planned.inputs:
            raise PlanError(
                f"stage {self.planned.name!r} asks for {stage!r}; add it to its deps in "
                "stages.yaml"
            )
        return self.planned.inputs[stage]

    def folder(self, stage: str) -> Path:
        """Finished folder of an input stage."""
        return self.root.folder(stage, self.key(stage))

    def units(self, stage: str) -> Sequence[FinishedUnit]:
        """Finished units of an input stage, by name."""
        manifest = read_manifest(self.folder(stage))
        more = manifest["report"].get("units", {})
        return [
            replace(done, report={**done.report, **more.get(done.name, {})})
            for done in finished_units(self.root, stage, manifest)
        ]

    def content(self, stage: str, *names: str) -> str:
        """Identity of what some files or folders in an input stage's folder hold.

        Raises:
            PlanError: if there is no such file.
        """
        files: Mapping[str, Sequence[object]] = read_manifest(self.folder(stage))["files"]
        found = {path: files[path] for path in _below(files, names)}
        for name in names:
            if not any(path == name or path.startswith(f"{name}/") for path in found):
                raise PlanError(f"stage {stage!r} made no {name} in {self.folder(stage)}")
        return digest(found)


def finished_units(
    root: Root, stage: str, manifest: Mapping[str, Any]
) -> list[FinishedUnit]:
    """Finished units that a stage's manifest lists."""
    return [
        FinishedUnit(
            unit["name"], unit["key"], root.unit(stage, unit["key"]), unit["report"]
        )
        for unit in manifest["units"]
    ]


def _below(files: Iterable[str], names: Sequence[str]) -> list[str]:
    folders = tuple(f"{name}/" for name in names)
    return [path for path in files if path in names or path.startswith(folders)]


def inputs_finished(plan: Plan, planned: PlannedStage) -> bool:
    """Whether all input stages are finished, so that the work can be split into units."""
    return all(plan.root.is_finished(name, key) for name, key in planned.inputs.items())
