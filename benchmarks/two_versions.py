"""What many small files cost by two versions of the code: seconds, files, bytes of a unit.

Every command runs in a process of its own, with the code of one checkout; both read the
same records, files of 60 tiny scenes (``benchmarks/ingest_files.py``). What a further unit
takes is told from roots of several sizes.

    git worktree add --detach ../before COMMIT
    python benchmarks/two_versions.py ../before . --files 15 30 60
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ingest_files import SCENES, write_files
from own_process import Usage, measure

SETTINGS = ("ingest.max_scenes_per_file=0", "train.steps=1", "train.validation_scenes=0")
STAGES = ("ingest", "tokenize")
"""Whose units are measured; what is between them is made too."""
LOOKING = ("status", "plan", "verify", "gc")


@dataclass(slots=True)
class Measured:
    """One root made by one version.

    Attributes:
        files: Of records: as many units has each stage.
        rows: Usage of each command.
        units: Files and bytes of a unit of each stage.
    """

    files: int
    rows: dict[str, Usage] = field(default_factory=dict)
    units: dict[str, tuple[float, float]] = field(default_factory=dict)


def main() -> None:
    """Measure all sizes by both versions, print two tables, and last one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("checkouts", type=Path, nargs=2, help="The older, and the newer.")
    parser.add_argument("--files", type=int, nargs="+", default=[4, 8])
    asked = parser.parse_args()
    checkouts = [path.resolve() for path in asked.checkouts]
    sizes: list[list[Measured]] = [[] for _ in checkouts]
    for files in sorted(asked.files):
        with tempfile.TemporaryDirectory(prefix="infgen-bench-") as name:
            records = Path(name) / "records"
            write_files(records, files)
            for version, (checkout, measured) in enumerate(
                zip(checkouts, sizes, strict=True)
            ):
                folder = Path(name) / f"version-{version}-{checkout.name}"
                folder.mkdir()
                measured.append(_measure(checkout, records, folder, files))
    report(sizes)


def _measure(checkout: Path, records: Path, folder: Path, files: int) -> Measured:
    """Make a root with the code of a checkout, and run every command on it."""
    os.environ["PYTHONPATH"] = str(checkout)
    found = Measured(files)
    at = ("--root", str(folder / "root"))
    how = (*at, "--records", str(records), "--profile", "tiny", "-s", *_between(SETTINGS))

    def run(name: str, *words: str) -> None:
        found.rows[name] = used = measure(["-m", "cli", *words], folder)
        print(
            f"{checkout.name}, {files} files: {name}: {used.cpu_s:.1f} CPU s",
            file=sys.stderr,
        )

    for stage in STAGES:
        if stage == "tokenize":
            run("build-vocab", "run", "build-vocab", *how)
        run(stage, "run", stage, *how)
        run(f"{stage}, all made", "run", stage, *how)
        written = folder / "root" / "store" / stage / "units"
        made = [each for each in written.rglob("*") if each.is_file()]
        # Without run.json, whose size varies with the seconds that it tells.
        bytes_made = sum(each.stat().st_size for each in made if each.name != "run.json")
        found.units[stage] = (len(made) / files, bytes_made / files)
    run("train, one step", "run", "train", *how)
    for command in LOOKING:
        run(command, command, *at)
    return found


def _between(settings: Sequence[str]) -> list[str]:
    """Put ``-s`` between settings."""
    first, *others = settings
    return [first, *(word for each in others for word in ("-s", each))]


def per_unit(points: Sequence[Measured], command: str) -> float:
    """Seconds of a core that a further unit takes: smallest root to largest."""
    first, last = points[0], points[-1]
    spent = last.rows[command].cpu_s - first.rows[command].cpu_s
    return spent / max(1, last.files - first.files)


def report(sizes: Sequence[Sequence[Measured]]) -> None:
    """Print the tables and the line of JSON."""
    older, newer = sizes
    shown = [f"{one.files} files" for one in newer] + ["a unit"]
    heads = "".join(f"{head:>12}" for head in shown) * len(sizes)
    print(f"{'CPU seconds':24}{heads}")
    for command in newer[0].rows:
        cells = ""
        for points in (older, newer):
            cells += "".join(f"{one.rows[command].cpu_s:12.2f}" for one in points)
            cells += f"{per_unit(points, command):12.4f}"
        print(f"{command:24}{cells}")
    for stage in STAGES:
        for what, name in enumerate(("files", "bytes")):
            cells = "".join(f"{points[-1].units[stage][what]:16,.1f}" for points in sizes)
            print(f"{name} of a unit of {stage}, {SCENES} scenes:{cells}")
    print(json.dumps({"older": _figures(older), "newer": _figures(newer)}))


def _figures(points: Sequence[Measured]) -> dict[str, object]:
    return {
        "files": [one.files for one in points],
        "cpu_s": {
            command: [round(one.rows[command].cpu_s, 2) for one in points]
            for command in points[0].rows
        },
        "cpu_s_per_unit": {
            command: round(per_unit(points, command), 4) for command in points[0].rows
        },
        "unit": {
            stage: [round(x, 1) for x in pair] for stage, pair in points[-1].units.items()
        },
    }


if __name__ == "__main__":
    main()
