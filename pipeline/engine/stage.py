"""What a stage is: how it cuts its work into units, does one, and gathers them.

The engine knows stages only through this file. A stage module, such as
``pipeline/stages/ingest.py``, ends in one ``STAGE = Stage(...)``;
``pipeline.engine.registry`` lists them.

``infgen status`` and dry runs import every stage module, so a stage module imports torch,
zarr, dask and polars inside its functions only, and ``plan`` uses none of them: it cuts by
what the reports of its inputs say.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

Report = dict[str, Any]
"""Few, JSON-able figures of one unit or of a whole stage, the same each time it is made.

Figures that vary from run to run (seconds, memory) go below the one key ``"run"``; they are
kept apart from the artefact, which is byte-identical between runs. What ``finish`` finds
out about single units goes below the key ``"units"``, by name: stages that read these units
find it in their reports.
"""


@dataclass(frozen=True, slots=True)
class Source:
    """One input file that no stage made.

    Attributes:
        url: Local path or fsspec URL.
        name: File name without folders, unique among the sources.
        fingerprint: Identity of the content.
    """

    url: str
    name: str
    fingerprint: str


@dataclass(frozen=True, slots=True)
class Unit:
    """A piece of a stage's work, done whole or not at all.

    Attributes:
        name: Unique in its stage, and fit to be part of a file name.
        inputs: Identities of what it reads, as ``{what: key or fingerprint}``.
        task: What ``work`` needs besides its settings: small and JSON-able.

    Name, inputs, task, and the stage's settings and version make the unit's key. Absolute
    paths and URLs in the task are left out of it (the identities in ``inputs`` stand for
    them), so that a root can be moved.
    """

    name: str
    inputs: Mapping[str, str]
    task: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class FinishedUnit:
    """A finished unit: its folder on disk and what it reported."""

    name: str
    key: str
    path: Path
    report: Report


@runtime_checkable
class Inputs(Protocol):
    """What a stage may ask of the stages before it."""

    @property
    def sources(self) -> Sequence[Source]:
        """Source files, by name."""

    def units(self, stage: str) -> Sequence[FinishedUnit]:
        """Finished units of an input stage, by name."""

    def folder(self, stage: str) -> Path:
        """Finished folder of an input stage (what its ``finish`` wrote)."""

    def key(self, stage: str) -> str:
        """Key of an input stage."""

    def content(self, stage: str, *names: str) -> str:
        """Identity of what some files or folders in an input stage's folder hold.

        Unlike its key it stays the same when the stage was made anew with equal results, so
        units that name it in their ``inputs`` are not made again for nothing.
        """


@runtime_checkable
class Progress(Protocol):
    """Where long work inside one unit or ``finish`` says how far it is."""

    def __call__(self, done: float, total: float, note: str = "") -> None:
        """Report so much of so much done, e.g. 300 of 1000 steps.

        In a stage that ``resumes`` this is also where SIGTERM arrives, as
        ``pipeline.engine.signals.Stopped``: save what is needed to go on, and raise it
        again.
        """


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage of the pipeline.

    Attributes:
        name: As in ``stages.yaml`` and on the command line.
        version: Raised by hand when the code would write different bytes.
        settings: Settings dataclasses the stage reads, by section of ``stages.yaml``.
            A stage with one section gets that dataclass as ``settings``; with several, a
            dictionary of them by section.
        plan: Cuts the work into units, from finished inputs. No disk writes.
        work: Does one unit: writes everything below ``target``, which the engine publishes
            whole; runs on any worker, several times if it must, and writes the same bytes
            each time. Errors in the data are reported, not raised.
        finish: Gathers the units into the stage's own folder ``target`` (index, tables).
        reads: Finds what the stage's settings name that no other stage of the plan makes,
            in the root folder of the experiment or elsewhere; it then counts as a source.
        normalize: Sets what decides nothing here to its default, section by section, before
            there is a key: what other settings make idle, or what is another stage's.
        modules: Modules whose code decides the bytes, but what they import of the library;
            the hash of all is recorded.
        resumes: ``work`` finds what a killed try left below ``target`` and goes on from it.
        in_driver: Units run in the driver's process, whatever the workers (training).
    """

    name: str
    version: int
    settings: Mapping[str, type]
    plan: "Callable[[Inputs, Any], Sequence[Unit]]"
    work: "Callable[[Unit, Path, Any, Progress], Report]"
    finish: "Callable[[Inputs, Sequence[FinishedUnit], Path, Any, Progress], Report]"
    reads: "Callable[[Path, Any], Sequence[Source]] | None" = None
    normalize: "Callable[[Mapping[str, Any]], Mapping[str, Any]] | None" = None
    modules: Sequence[str] = field(default=())
    resumes: bool = False
    in_driver: bool = False
