"""README's table of costs on a CPU, measured in one sitting, beside public code.

    python benchmarks/costs.py [--size paper-narrow-16] [--times 1] [--seconds 30]

Rows are those of ``rollout.py`` and ``training.py`` in one thread, each in a process of its
own. They are measured in turn, all of them ``--times`` times, and the quickest counts:
other work on the machine only makes them slower. Few-second rows are measured three times
as often. What the public code takes was measured once, on the same kind of machine, with
torch 2.13; in brackets is what it takes if the allocator keeps freed buffers.

Nothing else should run meanwhile. It takes about four minutes. The table is Markdown; the
last line is one JSON object.
"""

import argparse
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from measuring import SIZES, in_own_process
from rollout import Case as Rollouts
from training import Case as Training

HERE = Path(__file__).parent
BATCH = 32
SHORT_ROWS_TIMES = 3
"""How often a row of a few seconds is measured for each time that long ones are."""


@dataclass(frozen=True, slots=True)
class Reference:
    """What public code takes for the work of a row.

    Attributes:
        name: Of the code.
        least_s: CPU-seconds, the least ...
        most_s: ... and the most that were measured.
        kept_s: The same if the allocator keeps freed buffers, least and most.
        remark: What differs.
    """

    name: str
    least_s: float
    most_s: float
    kept_s: tuple[float, float]
    remark: str = ""

    def beside(self, ours_s: float) -> str:
        """Say it, with the ratios to what ours takes."""
        brackets = _range(*self.kept_s)
        ratios = _range(self.least_s / ours_s, self.most_s / ours_s, digits=0)
        least_s, most_s = self.kept_s
        kept = _range(least_s / ours_s, most_s / ours_s, digits=0)
        said = f"{self.name} {_range(self.least_s, self.most_s)} ({brackets})"
        return f"{said}: {ratios} times ({kept}){self.remark}"


MOTION = (
    Reference("InfGen", 108, 119, (65.6, 65.6)),
    Reference("CatK's SMART-7M", 12.0, 12.0, (12.6, 12.6)),
)
INSERTION = (Reference("InfGen", 394, 394, (254, 254), ", with 80 insertions"),)
STEP = (
    Reference("InfGen", 35.5, 38.6, (20.2, 20.2)),
    Reference("CatK", 11.4, 16.7, (9.6, 13.3)),
)
STEP_MEMORY = "InfGen's step 10.4 GiB"


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the table.

    Attributes:
        name: What is measured.
        script: Benchmark that measures it ...
        case: ... and what it is told.
        figure: Which of its figures counts.
        references: Public code beside it.
        is_short: Whether it takes a few seconds only.
    """

    name: str
    script: str
    case: Rollouts | Training
    figure: str
    references: tuple[Reference, ...] = ()
    is_short: bool = False


def rows(size: str, seconds: float, batch: int) -> list[Row]:
    """Make the rows for a size of the network and a length of rollouts."""

    def rollouts(
        name: str,
        case: Rollouts,
        references: tuple[Reference, ...] = (),
        *,
        is_short: bool = False,
    ) -> Row:
        return Row(name, "rollout.py", case, "used_s_per_rollout", references, is_short)

    def played(mode: str, rules: str, at_once: int) -> Rollouts:
        case = {"size": size, "batch": at_once, "mode": mode, "played": rules}
        more = {"seconds": seconds, "agents": 0, "roads": 0, "device": "cpu", "threads": 1}
        return Rollouts(**case, **more)  # type: ignore[arg-type]

    figure, step = "used_s_per_scene", Training(size, 1, 0, "cpu", 1, "float32")
    still, lively = played("motion-only", "plain", batch), played("long", "plain", batch)
    masked = played("long", "masked", batch)
    some, length = f"one of {batch} rollouts", f"{seconds:g} s"
    return [
        rollouts(f"{length} motion only, {some}", still, MOTION),
        rollouts(f"with insertion and removal, {some}", lively, INSERTION),
        rollouts(f"the same with the insertion mask, {some}", masked),
        rollouts(
            f"{length} motion only, alone", played("motion-only", "plain", 1), is_short=True
        ),
        rollouts(
            "with insertion and removal, alone", played("long", "plain", 1), is_short=True
        ),
        Row("a training step, per scene", "training.py", step, figure, STEP, is_short=True),
    ]


def measure(table: Sequence[Row], times: int) -> dict[str, dict[str, float]]:
    """Measure all rows in turn; of each figure the least counts, of memory the most."""
    found: dict[str, dict[str, float]] = {}
    for at in range(times * SHORT_ROWS_TIMES):
        for row in table:
            if not row.is_short and at >= times:
                continue
            print(f"{at + 1}: {row.name}", file=sys.stderr)
            figures = in_own_process(HERE / row.script, asdict(row.case))
            one = {
                "cpu_s": figures[row.figure],
                "mib": figures.get("peak_mib", figures.get("peak_rss_mib", 0.0)),
                "inserted": figures.get("entered", 0.0),
            }
            known = found.setdefault(row.name, one)
            known["cpu_s"] = min(known["cpu_s"], one["cpu_s"])
            known["mib"] = max(known["mib"], one["mib"])
    return found


def _range(least: float, most: float, digits: int | None = None) -> str:
    ends = [
        f"{x:.{digits}f}" if digits is not None else f"{x:.0f}" if x >= 20 else f"{x:.1f}"
        for x in (least, most)
    ]
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


def as_markdown(table: Sequence[Row], found: dict[str, dict[str, float]]) -> str:
    """Lay the rows out as a table of Markdown."""
    lines = ["| | infgen | public code | benchmark |", "|---|---|---|---|"]
    for row in table:
        ours = found[row.name]
        many = f", {ours['inserted']:.0f} insertions" if ours["inserted"] else ""
        beside = "; ".join(each.beside(ours["cpu_s"]) for each in row.references)
        script = row.script.removesuffix(".py")
        lines.append(
            f"| {row.name} | {ours['cpu_s']:.2f} CPU-s{many} | {beside} | `{script}` |"
        )
    gib = {row.name: found[row.name]["mib"] / 1024 for row in table}
    first, last = table[0].name, table[-1].name
    memory = f"{gib[first]:.1f} GiB; {gib[last]:.1f} GiB"
    lines.append(f"| memory of the first row; of that step | {memory} | {STEP_MEMORY} | |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", choices=sorted(SIZES), default="paper-narrow-16")
    parser.add_argument("--times", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--batch", type=int, default=BATCH)
    asked = parser.parse_args(arguments)
    load = os.getloadavg()[0]
    table = rows(asked.size, asked.seconds, asked.batch)
    found = measure(table, asked.times)
    print(as_markdown(table, found))
    print(f"\nOne thread, {asked.size}; load before it began: {load:.1f}\n")
    print(json.dumps({"size": asked.size, "load": load, "rows": found}))


if __name__ == "__main__":
    main()
