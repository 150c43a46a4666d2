"""How long the first words of Python take: `import infgen`, and the first rollout of 30 s.

Every row is a fresh process, so it pays for loading packages, weights and compiled code.
Files are in the system's cache after the first run, which is left out::

    python benchmarks/facade.py [--runs N]

Seconds are of the processor, one thread, and of the clock; the median of the runs. The last
line is one JSON object. `import infgen` is promised in 0.3 s of the processor.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Sequence

STEPS = {
    "import": "import infgen",
    "load": "sim = infgen.load('towns')",
    "scene": "scene = infgen.open_scenes('builtin', split='validation')[0]",
    "first_rollout": "sim.rollout(scene, seconds=30, count=1)",
    "next_rollout": "sim.rollout(scene, seconds=30, count=1, seed=1)",
    "of_eight": "sim.rollout(scene, seconds=30, count=8)",
}
"""What is measured, each after those before it."""
SAID = {
    "import": "`import infgen`",
    "load": "`infgen.load('towns')`",
    "scene": "`infgen.open_scenes('builtin', ...)[0]`",
    "first_rollout": "first rollout of 30 s",
    "next_rollout": "next rollout of 30 s",
    "of_eight": "8 rollouts of 30 s at once",
}
TIMED = """
import json, time
found, names = {{}}, {{}}
for name, code in {steps!r}.items():
    begun, used = time.perf_counter(), time.process_time()
    exec(code, names)
    found[name] = [time.process_time() - used, time.perf_counter() - begun]
print(json.dumps(found))
"""


def measure() -> dict[str, list[float]]:
    """Seconds of the processor and of the clock for each step, in a fresh process."""
    done = subprocess.run(
        [sys.executable, "-c", TIMED.format(steps=STEPS)],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    found: dict[str, list[float]] = json.loads(done.stdout)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table and the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=3, help="processes, after a first one")
    options = parser.parse_args(arguments)
    measure()
    runs = [measure() for _ in range(options.runs)]
    print("| | CPU-s | s |")
    print("|---|---:|---:|")
    figures: dict[str, float] = {}
    for name, said in SAID.items():
        cpu_s, wall_s = (statistics.median(run[name][at] for run in runs) for at in (0, 1))
        print(f"| {said} | {cpu_s:.3f} | {wall_s:.3f} |")
        figures[f"{name}_cpu_s"] = round(cpu_s, 4)
        figures[f"{name}_s"] = round(wall_s, 4)
    print(json.dumps({"runs": options.runs, **figures}))


if __name__ == "__main__":
    main()
