"""How long a video takes: 30 s at 1080p by as many processes as there are cores.

A made scene of the player's promised size (128 agents, 2,000 map tokens) with its log and
three rollouts, each in a pane::

    python benchmarks/video.py [--showings N] [--size 1920x1080] [--fps 25] [--workers N]

``cpu_s`` is what this process and the others computed for; on a machine that has nothing
else to do, the video takes about as long divided by the number of its cores. The last line
is one JSON object.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from player import STEPS, busy_film

from infgen.views.video.layout import Format
from pipeline.api.view_files import write_video


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table and the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--showings", type=int, default=4)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--fps", type=int, default=25)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    options = parser.parse_args(arguments)
    width, height = map(int, options.size.split("x"))
    film = busy_film(options.showings)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "busy.mp4"
        began, before = time.perf_counter(), os.times()
        write_video(film, path, Format(width, height, options.fps), workers=options.workers)
        wall_s, after = time.perf_counter() - began, os.times()
        size = path.stat().st_size
    cpu_s = sum(after[:4]) - sum(before[:4])
    seconds = (STEPS - 1 - film.now) / 10
    print("| showings | size | fps | seconds | wall s | CPU s | MB |")
    print("|---:|---:|---:|---:|---:|---:|---:|")
    cells = (options.showings, options.size, options.fps, f"{seconds:g}")
    figures = (f"{wall_s:.1f}", f"{cpu_s:.1f}", f"{size / 1e6:.1f}")
    print("| " + " | ".join(map(str, (*cells, *figures))) + " |")
    print(
        json.dumps(
            {
                "wall_s": round(wall_s, 2),
                "cpu_s": round(cpu_s, 2),
                "workers": options.workers,
                "file_bytes": size,
            }
        )
    )


if __name__ == "__main__":
    main()
