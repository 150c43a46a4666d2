"""Plans: which stages to make, and under which keys, before anything is made.

The key of a stage is the hash of everything that decides its bytes: the stage and its
version, its settings, the keys of the stages it reads, and the fingerprints of its source
files.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Protocol, runtime_checkable

from pipeline.engine.layout import Root
from pipeline.engine.registry import load_stage
from pipeline.engine.stage import Source, Stage, Unit

SOURCES = "sources"
"""Among ``deps``: the stage reads the source files."""


class PlanError(ValueError):
    """An impossible graph of stages, or a stage that breaks its contract."""


@dataclass(frozen=True, slots=True)
class StageEntry:
    """One stage of the graph.

    Attributes:
        name: As on the command line.
        module: Where its code is.
        deps: Stages that it reads, and ``sources``.
        params: Sections of settings that it reads.
        where: Its place in the file.
    """

    name: str
    module: str
    deps: tuple[str, ...]
    params: tuple[str, ...]
    where: str


@runtime_checkable
class Choice(Protocol):
    """Requested settings by section, and source files."""

    def build(self, section: str, kind: Any) -> Any:
        """Return the settings of a section, of the class that a stage names for it.

        Raises:
            ConfigError: for a setting that does not exist or cannot have its value.
        """

    def find_sources(self, root: Root) -> tuple[Source, ...]:
        """Find the source files and their identities.

        Raises:
            ConfigError: if there are none.
        """


@dataclass(frozen=True, slots=True)
class PlannedStage:
    """A stage with its settings, inputs, sources and key.

    Attributes:
        stage: Its code.
        module: Module of that code, for workers.
        settings: Settings that its functions get.
        values: Those that decide the result, as plain values by section.
        inputs: Keys of the stages it reads.
        sources: Source files it reads.
        key: Its own key.
    """

    stage: Stage
    module: str
    settings: Any
    values: Mapping[str, Mapping[str, Any]]
    inputs: Mapping[str, str]
    sources: tuple[Source, ...]
    key: str

    @property
    def name(self) -> str:
        """Name of the stage."""
        return self.stage.name

    def unit_key(self, unit: Unit) -> str:
        """Key of one unit of the stage's work."""
        return digest(
            {
                "stage": self.name,
                "version": self.stage.version,
                "settings": self.values,
                "unit": unit.name,
                "inputs": dict(unit.inputs),
                "task": without_locations(unit.task),
            }
        )


@dataclass(frozen=True, slots=True)
class Plan:
    """Stages to make, each after those it reads."""

    root: Root
    stages: Mapping[str, PlannedStage]

    def __getitem__(self, name: str) -> PlannedStage:
        return self.stages[name]

    def after(self, names: Iterable[str]) -> set[str]:
        """Return these stages and all that depend on them, directly or not."""
        found = set(names)
        for name, planned in self.stages.items():
            if found & planned.inputs.keys():
                found.add(name)
        return found


def make_plan(
    root: Root,
    entries: Mapping[str, StageEntry],
    chosen: Choice,
    targets: Sequence[str],
) -> Plan:
    """Compute the settings and keys of the targets and of all stages they need.

    Raises:
        ConfigError: for a setting that does not exist or cannot have its value, or for
            source files that are not there.
        PlanError: for a stage that does not exist, or stages that need each other.
    """
    order = stages_in_order(entries, targets)
    reads_sources = any(SOURCES in entries[name].deps for name in order)
    sources = chosen.find_sources(root) if reads_sources else ()
    stages: dict[str, PlannedStage] = {}
    for name in order:
        stages[name] = _plan_stage(entries[name], chosen, sources, stages, root)
    return Plan(root, stages)


def stages_in_order(entries: Mapping[str, StageEntry], targets: Sequence[str]) -> list[str]:
    """List the targets and all stages they depend on, each after its dependencies.

    Raises:
        PlanError: for a stage that does not exist, or stages that need each other.
    """
    order: list[str] = []
    for target in targets:
        _add_with_dependencies(target, "the command", entries, order, ())
    return order


def _add_with_dependencies(
    name: str,
    requested_by: str,
    entries: Mapping[str, StageEntry],
    order: list[str],
    above: tuple[str, ...],
) -> None:
    if name not in entries:
        near = get_close_matches(name, list(entries), n=1)
        did_you_mean = (
            f"did you mean {near[0]!r}?" if near else f"there is {', '.join(entries)}"
        )
        raise PlanError(
            f"{requested_by} asks for stage {name!r}, which does not exist; {did_you_mean}"
        )
    if name in above:
        circle = " -> ".join([*above[above.index(name) :], name])
        raise PlanError(f"{entries[name].where}: stages need each other: {circle}")
    if name in order:
        return
    for dep in entries[name].deps:
        if dep != SOURCES:
            _add_with_dependencies(dep, entries[name].where, entries, order, (*above, name))
    order.append(name)


def _plan_stage(
    entry: StageEntry,
    chosen: Choice,
    sources: tuple[Source, ...],
    before: Mapping[str, PlannedStage],
    root: Root,
) -> PlannedStage:
    from infgen.settings import key_values  # noqa: PLC0415  # Pydantic takes 0.1 s.

    stage = _load(entry)
    sections: Mapping[str, Any] = {
        section: chosen.build(section, kind) for section, kind in stage.settings.items()
    }
    if stage.normalize is not None:
        sections = stage.normalize(sections)
    values = {section: key_values(settings) for section, settings in sections.items()}
    only = next(iter(sections.values())) if len(sections) == 1 else sections
    read = sources if SOURCES in entry.deps else ()
    if stage.reads is not None:
        read = (*read, *stage.reads(root.path, only))
    inputs = {dep: before[dep].key for dep in entry.deps if dep != SOURCES}
    key = digest(
        {
            "stage": stage.name,
            "version": stage.version,
            "settings": values,
            "inputs": inputs,
            "sources": {source.name: source.fingerprint for source in read},
        }
    )
    return PlannedStage(stage, entry.module, only, values, inputs, read, key)


def _load(entry: StageEntry) -> Stage:
    try:
        stage = load_stage(entry.module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{entry.module}.".startswith(f"{error.name}."):
            raise
        raise PlanError(f"{entry.where}: there is no module {entry.module}") from error
    except AttributeError as error:
        raise PlanError(f"{entry.where}: {entry.module} ends in no STAGE") from error
    if stage.name != entry.name:
        raise PlanError(f"{entry.where}: {entry.module} holds stage {stage.name!r}")
    if set(stage.settings) != set(entry.params):
        raise PlanError(
            f"{entry.where}: {entry.name} lists params {sorted(entry.params)}, but its "
            f"code reads {sorted(stage.settings)}"
        )
    return stage


def digest(value: Any) -> str:
    """SHA-256 of a JSON-able value, independent of the order of its keys."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def without_locations(value: Any) -> Any:
    """Replace every absolute path and URL in a JSON-able value by None."""
    if isinstance(value, Mapping):
        return {name: without_locations(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [without_locations(part) for part in value]
    if isinstance(value, str) and (value.startswith("/") or "://" in value):
        return None
    return value
