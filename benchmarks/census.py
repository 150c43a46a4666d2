"""What commands cost on roots as large as WOMD's: 1,000 files, 487,000 scenes, and more.

Roots are made in minutes: with true metadata, and the arrays of one shard linked into all
(``benchmarks/census_root.py``). Every command runs in a process of its own. The promises:
nothing but ``verify`` takes more than 10 seconds of a core or 1 GiB, and no command's cost
for each further scene grows with their number.

    python benchmarks/census.py                       # roots of 5,000 and 10,000 scenes
    python benchmarks/census.py --files 21 210 1000   # up to WOMD's size: an hour
    python benchmarks/census.py --files 1 --held-out 150               # simulated whole
    python benchmarks/census.py --files 1750 --last tokenize           # a million scenes
"""

import argparse
import json
import math
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from own_process import Usage, measure

STEPS = Path(__file__).with_name("census_steps.py")
GOALS = {"cpu_s": 10.0, "peak_mib": 1024.0}
EXEMPT = ("verify", "dask", "probe")
"""``verify`` looks at every file, Dask's tasks are looked at one by one, and a probe runs
every stage of three methods."""
STEEPER = 1.5
"""A further scene may cost so many times what one of a smaller root cost."""
NOISE_S = 1.0
"""Differences below so many seconds tell nothing about growth."""
SPLITS = ("training", "validation")
WOMD_FILES = 1000
VALIDATION_FILES = 150
GATHERED = ("ingest", "build-vocab", "tokenize", "train", "calibrate", "rollout")
SCORED = ("reference", "score", "report")
STEPS_AFTER = {
    "tokenize": {"train: index and first batch": "index"},
    "rollout": {"rollout: split into units": "split", "dask": "schedule"},
    "score": {"score: split into units": "split"},
}
"""What is measured besides commands once a stage is made."""
UNITLESS = ("train", "calibrate", "report")
"""Their units are made by the command that is measured, or there are none."""


@dataclass(slots=True)
class Root:
    """One root and what was measured on it.

    Attributes:
        folder: Of records and root.
        census: Fields of ``census_root.Census``.
        rows: Usage of each command, in the order they ran.
        found: What steps found.
        made_s: Seconds that making the units took.
    """

    folder: Path
    census: dict[str, object]
    rows: dict[str, Usage] = field(default_factory=dict)
    found: dict[str, dict[str, float]] = field(default_factory=dict)
    made_s: float = 0.0

    @property
    def scenes(self) -> int:
        """Scenes of both splits."""
        files, each = self.census["files"], self.census["scenes_per_file"]
        assert isinstance(files, dict)
        assert isinstance(each, dict)
        return sum(count * each[split] for split, count in files.items())

    def command(self, name: str, *words: str) -> None:
        """Measure a command line of infgen."""
        self._note(name, measure(["-m", "cli", *words], self.folder))

    def step(self, name: str, step: str, stage: str = "") -> None:
        """Measure a step."""
        used = self._step(step, stage)
        self._note(name, used)
        self.found[name] = json.loads(used.text.splitlines()[-1])

    def make(self, step: str, stage: str = "") -> None:
        """Do a step that is not measured."""
        self.made_s += self._step(step, stage).wall_s

    def _note(self, name: str, used: Usage) -> None:
        """Keep a row, and show it: the others may take long."""
        self.rows[name] = used
        row = f"{used.wall_s:.1f} s, {used.cpu_s:.1f} CPU s, {used.peak_mib:.0f} MiB"
        print(f"{self.scenes:,} scenes: {name}: {row}", file=sys.stderr, flush=True)

    def _step(self, step: str, stage: str) -> Usage:
        words = [str(STEPS), step, str(self.folder), json.dumps(self.census), stage]
        return measure(words, self.folder)


def main() -> None:
    """Measure all roots, print a table, and last one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--files", type=int, nargs="+", default=[10, 21])
    parser.add_argument("--held-out", type=int, help="Of the files, in proportion if none.")
    parser.add_argument("--last", choices=[*GATHERED, *SCORED], help="No stage after it.")
    parser.add_argument("--scenes", type=int, nargs=2, default=[487, 296])
    parser.add_argument("--scenes-per-unit", type=int, default=8)
    parser.add_argument("--rollouts", type=int, default=32)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--folder", type=Path, help="Where; default: for temporary files.")
    parser.add_argument("--keep", action="store_true", help="Leave the roots there.")
    asked = parser.parse_args()
    roots = []
    for files in sorted(asked.files):
        folder = Path(tempfile.mkdtemp(prefix="infgen-census-", dir=asked.folder))
        held_out = asked.held_out or math.ceil(files * VALIDATION_FILES / WOMD_FILES)
        census: dict[str, object] = {
            "files": {"training": files, "validation": held_out},
            "scenes_per_file": dict(
                zip(("training", "validation"), asked.scenes, strict=True)
            ),
            "scenes_per_unit": asked.scenes_per_unit,
            "rollouts": asked.rollouts,
            "seconds": asked.seconds,
        }
        roots.append(Root(folder, census))
        measure_root(roots[-1], asked.last or SCORED[-1])
        if not asked.keep:
            shutil.rmtree(folder)
    report(roots)


def measure_root(root: Root, last: str) -> None:
    """Make a root up to a stage, and measure every command on the way."""
    root.make("write")
    records = ("--records", str(root.folder / "records"), "--profile", "tiny")
    at = ("--root", str(root.folder / "root"))
    root.command("plan, nothing made", "plan", *at, *records)
    for name in ("probe of plan --preset", "plan --preset, probed before"):
        root.command(name, "plan", "--preset", "paper", *at, *records)
    stages = (*GATHERED, *SCORED)
    for stage in stages[: stages.index(last) + 1]:
        _make_stage(root, stage, at)
        for name, step in STEPS_AFTER.get(stage, {}).items():
            root.step(name, step, stage)
    for command in ("status", "plan", "gc", "verify"):
        root.command(command, command, *at)


def _make_stage(root: Root, stage: str, at: Sequence[str]) -> None:
    """Make a stage's units, and measure the run that finds them and gathers them."""
    if stage not in UNITLESS:
        root.make("fill", stage)
    if stage == "rollout":
        root.command("status, rollouts not gathered", "status", *at)
    root.command(f"run {stage}", "run", stage, *at)


def report(roots: Sequence[Root]) -> None:
    """Print the table and the line of JSON."""
    print(f"{'scenes':34}" + "".join(f"{root.scenes:>24,}" for root in roots))
    print(f"{'':34}" + f"{'s':>8}{'CPU s':>8}{'MiB':>8}" * len(roots))
    for name in roots[0].rows:
        cells = [root.rows[name] for root in roots]
        figures = "".join(f"{c.wall_s:8.1f}{c.cpu_s:8.1f}{c.peak_mib:8.0f}" for c in cells)
        print(f"{name:34}{figures}")
    for name, found in roots[-1].found.items():
        print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in found.items()))
    print(json.dumps(summary(roots)))


def summary(roots: Sequence[Root]) -> dict[str, object]:
    """All figures, the goals that are missed at the largest size, and what grows."""
    largest = roots[-1]
    missed = [
        name
        for name, used in largest.rows.items()
        if not name.startswith(EXEMPT)
        and (used.cpu_s > GOALS["cpu_s"] or used.peak_mib > GOALS["peak_mib"])
    ]
    steeper = [name for name in largest.rows if grows([_point(r, name) for r in roots])]
    return {
        "goals": GOALS,
        "missed": missed,
        "superlinear": steeper,
        "roots": [
            {
                "scenes": root.scenes,
                "made_s": round(root.made_s, 1),
                "rows": {
                    name: [round(u.wall_s, 2), round(u.cpu_s, 2), round(u.peak_mib)]
                    for name, u in root.rows.items()
                },
                "found": root.found,
            }
            for root in roots
        ],
    }


def _point(root: Root, name: str) -> tuple[int, float]:
    return root.scenes, root.rows[name].cpu_s


def grows(points: Sequence[tuple[int, float]]) -> bool:
    """Whether a further scene costs more in the largest root than in the smaller ones.

    Args:
        points: Scenes of a root, and seconds of a core; three roots or more.

    Examples:
        >>> grows([(10, 1.0), (110, 2.0), (210, 3.0)])
        False
        >>> grows([(10, 1.0), (110, 2.0), (210, 13.0)])
        True
    """
    if len(points) < 3:
        return False
    (first, first_s), (middle, middle_s), (last, last_s) = points[0], points[-2], points[-1]
    slope = max(middle_s - first_s, NOISE_S) / (middle - first)
    return (last_s - middle_s) / (last - middle) > STEEPER * slope


if __name__ == "__main__":
    main()
