"""Everything that is to be known of a GPU, in one command and a few minutes.

::

    python benchmarks/gpu.py [--device cuda] [--minutes 8]
    python benchmarks/gpu.py --device cpu --small      # the code, not the speed

Whether it computes what a CPU computes: logits of a pass over a scene, and choices of
motion tokens with the package's weights when both are shown the same token steps. Scenes a
second in training and rollouts (of 30 s, default settings) a second, for batches of 32, 256
and 1,024, two sizes, float32 and bf16, with the share of the device's peak (its maker's, by
its name, or else that of a large matrix product here) and memory; rollouts with passes of
insertion as CUDA graphs, and whether they insert the same. The ten dearest kernels.

Rows run in processes of their own, a few in each. A row that fails is printed as such, and
the rest goes on in another process; rows for which time is too short are "not run". The
last line is one JSON object. The exit code is 1 if the device and a CPU do not agree.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from queue import Empty, SimpleQueue
from typing import IO, Any

import torch
from gpu_rows import Place, Row, measure

from pipeline.commands.screen import show_table

BATCHES, FEW_BATCHES = (32, 256, 1024), (1,)
START_S, GRACE_S = 15.0, 20.0
"""No process is started for less, and none gets more than so long beyond its time."""
NOT_RUN = "not run"
Found = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Group:
    """Rows that are measured by one process, dearer ones last.

    Attributes:
        rows: The rows.
        weight: Its share of the time that is left.
    """

    rows: tuple[Row, ...]
    weight: float


def make_groups(*, small: bool) -> list[Group]:
    """List all rows, in the order in which they are to be known."""
    sizes = ("tiny",) if small else ("small", "paper")
    few, profiled = (1, "tiny") if small else (32, "paper")
    agree = [
        *(Row("logits", size, 1, "float32") for size in sizes),
        *(Row("choices", "builtin", 4, word) for word in ("float32", "auto", "bf16")),
    ]
    groups = [Group(tuple(agree), 1.0)]
    for size, weight in zip(sizes, (1.5, 2.5), strict=False):
        batches = FEW_BATCHES if small else BATCHES
        rollouts = [
            Row("rollouts", size, batch, word)
            for batch in batches
            for word in ("float32", "auto", "bf16")
        ]
        graphs = [Row("graphs", size, batch, "auto") for batch in batches]
        training = [
            Row("training", size, batch, word)
            for batch in batches
            for word in ("float32", "bf16")
        ]
        groups += [
            Group(tuple(rows), weight * share)
            for rows, share in ((rollouts, 1.0), (graphs, 0.5), (training, 1.0))
        ]
    groups.append(Group((Row("kernels", profiled, few, "auto"),), 1.0))
    if small:  # Most of the time would go into starting processes.
        return [Group(tuple(row for group in groups for row in group.rows), 1.0)]
    return groups


@dataclass
class Budget:
    """Time that is left, and what it is to be spent on."""

    end: float
    weights: list[float] = field(default_factory=list)

    def left_s(self) -> float:
        """Seconds left in all."""
        return self.end - time.monotonic()

    def next_s(self) -> float:
        """Seconds for the next group: its share of what is left."""
        share = self.weights[0] / sum(self.weights)
        self.weights.pop(0)
        return share * self.left_s()


def measure_all(groups: Sequence[Group], place: Place, budget: Budget) -> Iterator[Found]:
    """Measure all rows that there is time for; one record per row, in order."""
    for group in groups:
        found = _measure_group(group.rows, place, time.monotonic() + budget.next_s())
        for row in group.rows:
            yield {"row": row, **found.get(row.name, {"failed": NOT_RUN})}


def _measure_group(rows: Sequence[Row], place: Place, end: float) -> dict[str, Found]:
    """Measure rows; after one that ended its process, the others in another process."""
    found: dict[str, Found] = {}
    waiting = list(rows)
    while waiting and (end - time.monotonic() > START_S or place.small):
        ended_well = _in_process(waiting, place, end, found)
        waiting = [row for row in waiting if row.name not in found]
        if ended_well:
            break
    return found


def _in_process(
    rows: Sequence[Row], place: Place, end: float, found: dict[str, Found]
) -> bool:
    """Measure rows in a process of their own; return whether it ended by itself.

    If it did not, the row that ended it is among those that are found, with the reason.
    """
    work = {
        "rows": [asdict(row) for row in rows],
        "place": asdict(place),
        "seconds": end - time.monotonic(),
    }
    command = [sys.executable, __file__, "--work", json.dumps(work)]
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True
        ) as running,
    ):
        assert running.stdout is not None
        begun, in_time = rows[0].name, True
        for line in _lines(running.stdout, end + GRACE_S):
            if line is None:
                running.kill()
                in_time = False
            elif "begun" in line:
                begun = str(line["begun"])
            else:
                found[str(line.pop("name"))] = line
        code = running.wait()
        if not in_time:
            found.setdefault(begun, {"failed": f"{NOT_RUN}: it took too long"})
            return True
        if code:
            errors.seek(0)
            said = errors.read().strip() or f"exit code {code}"
            print(said[-3000:], file=sys.stderr)
            found.setdefault(begun, {"failed": said.splitlines()[-1][:200]})
    return code == 0


def _lines(source: IO[str], until: float) -> Iterator[Found | None]:
    """Yield records that a process prints, to its end; None once, when time is up."""
    queue: SimpleQueue[str | None] = SimpleQueue()

    def read() -> None:
        for line in source:
            queue.put(line)
        queue.put(None)

    threading.Thread(target=read, daemon=True).start()
    while True:
        try:
            line = queue.get(timeout=max(0.1, until - time.monotonic()))
        except Empty:
            yield None
            return
        if line is None:
            return
        if line.startswith("{"):  # Profilers print lines of their own.
            yield json.loads(line)


def work_on(rows: Sequence[Row], place: Place, end: float) -> None:
    """Measure rows in this process, and print each as JSON; end early if time is short."""
    last_s = 0.0
    for row in rows:
        if end - time.monotonic() < last_s and not place.small:
            return  # The next one takes as long, or longer.
        print(json.dumps({"begun": row.name}), flush=True)
        start = time.monotonic()
        try:
            found = measure(row, place)
        except torch.OutOfMemoryError:
            found = {"failed": "out of memory"}
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
        last_s = time.monotonic() - start
        print(json.dumps({"name": row.name, **found}), flush=True)


def _cell(found: Found, name: str, form: str) -> str:
    return f"{found[name]:{form}}" if name in found else ""


def show_agreement(found: Sequence[Found]) -> None:
    """Print how a device and a CPU agree."""
    show_table(
        "agreement with a CPU",
        ("what", "size", "precision", "largest gap of logits", "same choices", "holds"),
        [
            (
                one["row"].kind, one["row"].size, one["row"].precision,
                _cell(one, "largest_gap", ".2e") or one["failed"],
                _cell(one, "same", ".1%"),
                {True: "yes", False: "NO", None: ""}[one.get("holds")],
            )
            for one in found
        ],
    )  # fmt: skip


def show_speed(found: Sequence[Found]) -> None:
    """Print scenes and rollouts a second."""
    show_table(
        "scenes (training) and rollouts of 30 s, a second",
        (
            "what", "size", "batch", "precision", "a second", "ms a step", "peak MiB",
            "GFLOP each", "of peak", "peak is", "same without graphs",
        ),
        [
            (
                one["row"].kind, one["row"].size, one["row"].batch, one["row"].precision,
                _cell(one, "per_s", ".4g") or one["failed"],
                _cell(one, "step_ms", ".4g"), _cell(one, "peak_mib", ".0f"),
                _cell(one, "gflop_each", ".3g"), _cell(one, "of_peak", ".2%"),
                one.get("peak", ""), _cell(one, "same", ".1%"),
            )
            for one in found
        ],
    )  # fmt: skip


def show_kernels(found: Found) -> None:
    """Print the dearest kernels."""
    title = f"dearest kernels of a step, {found['row'].size}, batch {found['row'].batch}"
    if "failed" in found:
        print(f"{title}: {found['failed']}")
        return
    for what in ("training", "rollouts"):
        rows = [(name[:90], f"{ms:.3g}", calls) for name, ms, calls in found[what]]
        show_table(f"{title}: {what}", ("kernel", "ms", "calls"), rows)


def report(found: Sequence[Found], place: Place, minutes: float) -> bool:
    """Print tables and the line of JSON; return whether device and CPU agree."""
    by_kind: dict[str, list[Found]] = {}
    for one in found:
        by_kind.setdefault(one["row"].kind, []).append(one)
    agreement = [*by_kind["logits"], *by_kind["choices"]]
    show_agreement(agreement)
    show_speed([*by_kind["rollouts"], *by_kind["graphs"], *by_kind["training"]])
    for one in by_kind["kernels"]:
        show_kernels(one)
    rows = {
        one["row"].name: {name: value for name, value in one.items() if name != "row"}
        for one in found
    }
    about = {
        "device": place.name,
        "torch": torch.__version__,
        "small": place.small,
        "minutes": round(minutes, 2),
        "not_measured": [name for name, each in rows.items() if "failed" in each],
        "rows": rows,
    }
    print(json.dumps(about))
    return all(one.get("holds", True) for one in agreement)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what there is time for, or the rows that another process asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    here = "cuda" if torch.cuda.is_available() else "cpu"
    parser.add_argument("--device", default=here, help=f"default: {here}")
    parser.add_argument("--small", action="store_true", help="a tiny network and scene")
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--threads", type=int, default=1, help="of the processor")
    parser.add_argument("--work", type=json.loads, help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    start = time.monotonic()
    if asked.work:
        rows = [Row(**row) for row in asked.work["rows"]]
        work_on(rows, Place(**asked.work["place"]), start + asked.work["seconds"])
        return 0
    place = Place(asked.device, asked.threads, 4.0, asked.small)
    place = replace(place, row_s=0.1) if asked.small else place
    groups = make_groups(small=asked.small)
    budget = Budget(start + 60 * asked.minutes, [group.weight for group in groups])
    found = []
    for one in measure_all(groups, place, budget):
        what = one.get("failed", "done")
        print(
            f"{time.monotonic() - start:4.0f} s {one['row'].name}: {what}", file=sys.stderr
        )
        found.append(one)
    return 0 if report(found, place, (time.monotonic() - start) / 60) else 1


if __name__ == "__main__":
    sys.exit(main())
