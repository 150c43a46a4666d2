"""The run passport: what was made of what, with which settings, and where and how fast.

What is the same each time the same is made stands in the report. Machines and times are
not: they go to a page of their own below ``run``, which no manifest lists, and which the
report shows where it lies beside it.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.views.tables import Cell, Table, flatten
from pipeline.engine.layout import KEY_DIGITS, RUN
from pipeline.engine.manifest import read_manifest

if TYPE_CHECKING:
    from pipeline.engine.stage import Inputs

MAX_QUARANTINED = 20
Manifests = Mapping[str, Mapping[str, Any]]


def passport(inputs: "Inputs", manifests: Manifests) -> list[Table]:
    """What was run on what: keys, settings, versions, counts and what was left out."""
    settings = [
        [f"{name}: {setting}", value]
        for name, found in manifests.items()
        for setting, value in flatten(found["settings"])
    ]
    figures = [
        [f"{name}: {figure}", value]
        for name, found in manifests.items()
        for figure, value in flatten(found["report"])
    ]
    packages = flatten(manifests["score"]["packages"])
    sources = [
        [name, mark] for name, mark in sorted(manifests["ingest"]["sources"].items())
    ]
    return [
        _stages(inputs, manifests),
        Table("Counts", ["figure", "value"], figures),
        *_vocabulary(inputs),
        _quarantine(inputs),
        Table("Sources", ["file", "fingerprint"], sources),
        Table("Settings", ["setting", "value"], settings),
        Table("Versions", ["package", "version"], packages),
    ]


def _stages(inputs: "Inputs", manifests: Manifests) -> Table:
    rows: list[Sequence[Cell]] = [
        [
            name,
            found["key"][:KEY_DIGITS],
            found["version"],
            found["code"][:KEY_DIGITS],
            len(found["units"]),
            _bytes(found) + sum(_bytes(unit) for unit in _units(inputs, name)),
        ]
        for name, found in manifests.items()
    ]
    return Table("Stages", ["stage", "key", "version", "code", "units", "bytes"], rows)


def _units(inputs: "Inputs", stage: str) -> Iterator[Mapping[str, Any]]:
    for done in inputs.units(stage):
        yield read_manifest(done.path)


def _bytes(manifest: Mapping[str, Any]) -> int:
    return sum(size for size, _ in manifest["files"].values())


def _vocabulary(inputs: "Inputs") -> list[Table]:
    path = inputs.folder("build-vocab") / "report.json"
    if not path.is_file():
        return []
    rows = flatten(json.loads(path.read_text()))
    return [Table("Vocabularies", ["figure", "value"], rows)]


def _quarantine(inputs: "Inputs") -> Table:
    import polars as pl  # noqa: PLC0415

    found = pl.read_parquet(inputs.folder("ingest") / "quarantine.parquet")
    shown = min(MAX_QUARANTINED, len(found))
    return Table(
        "Quarantined records",
        found.columns,
        list(found.head(shown).iter_rows()),
        note=f"{shown} of {len(found)}; all are in quarantine.parquet of stage ingest.",
    )


def times(inputs: "Inputs", stages: Sequence[str]) -> list[Table]:
    """Where and when every stage was made, and how long it took."""
    rows: list[Sequence[Cell]] = []
    machines: dict[str, dict[str, Any]] = {}
    devices: Counter[tuple[str, str]] = Counter()
    for name in stages:
        gathered = _run(inputs.folder(name))
        units = [_run(done.path) for done in inputs.units(name)]
        devices.update((name, device) for run in units for device in _device(run))
        for run in (gathered, *units):
            for machine, about in _machine(run):
                machines.setdefault(machine, {**about, "stages": {}})["stages"][name] = None
        seconds = [run["seconds"] for run in units if "seconds" in run]
        begun = [run["started"] for run in (gathered, *units) if "started" in run]
        longest = max(seconds, default=None)
        last = gathered.get("seconds")
        rows.append([name, min(begun, default=None), _sum(seconds), longest, last])
    columns = ["stage", "begun", "seconds of all units", "longest unit", "gathering"]
    return [
        _devices(devices),
        Table("Seconds", columns, rows, note="Units may have been made side by side."),
        Table("Machines", _MACHINE, [_row(*each) for each in machines.items()]),
    ]


def _device(run: Mapping[str, Any]) -> Iterator[str]:
    """On which device a unit's network computed, if it says so."""
    device = run.get("report", {}).get("device")
    if device is not None:
        yield str(device)


def _devices(found: Mapping[tuple[str, str], int]) -> Table:
    """On which devices the network computed, in training and in rollouts."""
    rows: list[Sequence[Cell]] = [
        [stage, device, units] for (stage, device), units in found.items()
    ]
    return Table("Devices", ["stage", "device and precision", "units"], rows)


_MACHINE = ["host", "processor", "cores", "memory, GiB", "graphics", "stages"]


def _run(folder: Path) -> dict[str, Any]:
    """What a made folder says of the run that made it; nothing if that is lost."""
    try:
        found: dict[str, Any] = json.loads((folder / RUN).read_text())
    except (OSError, ValueError):
        return {}
    return found


def _machine(run: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    if "host" in run:
        yield run["host"], run.get("machine", {})


def _row(host: str, about: Mapping[str, Any]) -> list[Cell]:
    known = (about.get(name) for name in ("processor", "cores", "memory_gib"))
    gpus = ", ".join(about.get("gpus", ())) or "none"
    return [host, *known, gpus, ", ".join(about["stages"])]


def _sum(seconds: Sequence[float]) -> float | None:
    return round(sum(seconds), 1) if seconds else None
