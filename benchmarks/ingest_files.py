"""How long many small files take to ingest, beside few large ones: the cost of a unit.

Each file is a unit of work with its folder, manifest and syncs. The promise: 1,001 files of
60 tiny scenes within five minutes on two cores, which is 0.6 seconds of a core for a unit.
Where fewer files are measured, 1,001 are extrapolated in proportion.

    python benchmarks/ingest_files.py [--files 40]
    python benchmarks/ingest_files.py --files 1001 --dask local:2  # the promise itself
"""

import argparse
import json
import tempfile
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from measuring import read_small_scene
from own_process import measure

from infgen.scene import RoadMap, Scene, Signals
from infgen.sources.tfrecord import frame
from infgen.sources.womd_write import encode_scenario

SCENES = 60
WANTED = 1001
GOAL_S = 300.0
CORES = 2
ID = "0" * 16


def main() -> None:
    """Measure, print a table, and last one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--files", type=int, default=40)
    parser.add_argument("--dask", default="none", help="Workers, as of infgen run.")
    asked = parser.parse_args()
    files = asked.files
    with tempfile.TemporaryDirectory(prefix="infgen-bench-") as name:
        folder = Path(name)
        write_files(folder / "records", files)
        words = ["-m", "cli", "ingest", str(folder / "records")]
        words += ["--root", str(folder / "root"), "--dask", asked.dask]
        used = measure(words, folder)
        start = measure(words, folder)  # All is made: it only looks.
        units = folder / "root" / "store" / "ingest" / "units"
        each = sum(path.is_file() for path in units.rglob("*")) / files
    cpu_s = (used.cpu_s - start.cpu_s) / files
    wall_s = (used.wall_s - start.wall_s) / files
    figures = {
        "files": files,
        "scenes_per_file": SCENES,
        "files_per_unit": round(each, 2),
        "dask": asked.dask,
        "cpu_s": round(used.cpu_s, 1),
        "wall_s": round(used.wall_s, 1),
        "peak_mib": round(used.peak_mib),
        "cpu_s_per_unit": round(cpu_s, 3),
        "wall_s_per_unit": round(wall_s, 3),
        "cpu_s_of_1001": round(WANTED * cpu_s, 1),
        "minutes_of_1001_on_two_cores": round(WANTED * cpu_s / CORES / 60, 2),
        "goal_minutes": GOAL_S / 60,
    }
    for figure, value in figures.items():
        print(f"{figure:32}{value:>10}")
    print(json.dumps(figures))


def write_files(folder: Path, files: int) -> None:
    """Write TFRecords of tiny scenes: few agents, and next to no map."""
    folder.mkdir()
    record = encode_scenario(tiny(read_small_scene()))
    for file in range(files):
        ids = (f"{file:08x}{row:08x}".encode() for row in range(SCENES))
        data = b"".join(frame(record.replace(ID.encode(), each, 1)) for each in ids)
        (folder / f"training.tfrecord-{file:05d}-of-{files:05d}").write_bytes(data)


OF_FEATURES = (
    "feature_id",
    "feature_type",
    "feature_subtype",
    "speed_limit_mph",
    "interpolating",
)


def tiny(scene: Scene) -> Scene:
    """Leave out all of a scene's map but its first feature, and its signals."""
    road_map = scene.road_map
    kept = _without_rows(road_map)
    kept |= {name: getattr(road_map, name)[:1] for name in OF_FEATURES}
    kept["point_offsets"] = road_map.point_offsets[:2]
    kept["xyz_m"] = road_map.xyz_m[: int(road_map.point_offsets[1])]
    return replace(
        scene,
        scenario_id=ID,
        road_map=RoadMap(**kept),
        signals=Signals(**_without_rows(scene.signals)),
    )


def _without_rows(record: RoadMap | Signals) -> dict[str, np.ndarray]:
    return {field.name: getattr(record, field.name)[:0] for field in fields(record)}


if __name__ == "__main__":
    main()
