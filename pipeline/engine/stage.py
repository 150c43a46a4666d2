"""What a stage is: how it splits its work into units, does one, and collects them.

The engine knows stages only through this file. A stage module, such as
``pipeline/stages/ingest.py``, ends in one ``STAGE = Stage(...)``;
``pipeline.engine.registry`` lists them.

``infgen status`` and dry runs import every stage module. A stage module therefore imports
torch, zarr, dask and polars inside its functions only, and ``plan`` uses none of them: it
splits the work by the reports of its inputs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

Report = dict[str, Any]
"""A few JSON-able figures of a unit or a stage, the same each time it is made.

Figures that vary from run to run (seconds, memory) go under the key ``"run"``. They are
stored outside the artefact, which is byte-identical between runs. Figures that ``finish``
computes for single units go under the key ``"units"``, by name; stages that read these
units find them in the units' reports.
"""


@dataclass(frozen=True, slots=True)
class Source:
    """One input file that no stage made, or a group of small ones.

    Attributes:
        url: Local path or fsspec URL.
        name: File name without folders, unique among the sources.
        fingerprint: Identity of the content.
        parts: What it consists of, where it is a group of small files: JSON-able, for the
            tasks of units.
    """

    url: str
    name: str
    fingerprint: str
    parts: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit of a stage's work, finished or not there.

    Attributes:
        name: Unique in its stage; may be part of a file name.
        inputs: Identities of what it reads, as ``{name: key or fingerprint}``.
        task: Arguments of ``work`` besides its settings: small and JSON-able.

    The unit's key is the hash of its name, inputs and task and of the stage's settings and
    version. Absolute paths and URLs in the task are left out (``inputs`` identifies what
    they hold), so that a root can be moved.
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
    """What a stage reads of the stages before it."""

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
        """Fingerprint of some files or folders in an input stage's folder.

        Unlike the stage's key it stays the same when the stage is made again with equal
        results. Units that name it in their ``inputs`` are then not made again.
        """


@runtime_checkable
class Progress(Protocol):
    """Called by long work inside one unit or ``finish`` to report progress."""

    def __call__(self, done: float, total: float, note: str = "") -> None:
        """Report that ``done`` of ``total`` is done, e.g. 300 of 1000 steps.

        In a stage that ``resumes``, SIGTERM also arrives here, as
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
            With one section ``settings`` is that dataclass; with several, a dictionary of
            them by section.
        plan: Splits the work into units, from finished inputs. Writes nothing to disk.
        work: Does one unit: writes everything below ``target``, which the engine then
            publishes as a whole. Runs on any worker, possibly several times, and writes
            the same bytes each time. Errors in the data are reported, not raised.
        finish: Collects the units in the stage's own folder ``target`` (index, tables).
        reads: Finds files that the stage's settings name and no other stage of the plan
            makes, in the root folder of the experiment or elsewhere. They count as sources.
        normalize: Sets settings without effect on this stage to their defaults before the
            key is computed: those that other settings switch off, or that concern other
            stages.
        modules: Modules whose code decides the bytes. With what they import of ``infgen``
            they are hashed, and the hash is recorded.
        resumes: ``work`` continues from what a killed attempt left below ``target``.
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
