"""How fast raw records become scenes on disk, on one core, beside merely parsing them.

The promises: at least 25 scenes a second and core, at most a third of the records' bytes on
disk, at most 1 GiB of memory whatever the input. The floor is to gunzip the same records,
check their checksums and walk every field of their messages, and no more.

Shared scenes of other sources stand beside, where they are there, each source alone. There
is no floor for them.

    python benchmarks/ingest.py [RECORDS...]
"""

import argparse
import json
import resource
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import infgen
from infgen.config import IngestSettings
from infgen.scene import FeatureType
from infgen.sources import wire
from infgen.sources.tfrecord import Record, iter_records
from infgen.sources.wire import BYTES, Spans, tag
from infgen.sources.womd import scene_or_bad_record
from pipeline.engine.layout import Root
from pipeline.engine.stage import FinishedUnit, Report, Source, Unit
from pipeline.stages.ingest import STAGE
from pipeline.storage.sources.fingerprints import fingerprint
from pipeline.storage.sources.source_files import find_sources

SHARED = Path(__file__).parents[1] / "../shared/data/womd"
BUILTIN = Path(infgen.__file__).parent / "sources/towns/records"
OTHERS = ("av2", "scenarionet")
TOTALS = ("scenes", "quarantined", "record_bytes", "disk_bytes")

TRACK, DYNAMIC_STATE, FEATURE = tag(2, BYTES), tag(7, BYTES), tag(8, BYTES)
LINE, OUTLINE = tag(2, BYTES), tag(1, BYTES)
POINTS = {
    tag(FeatureType.LANE, BYTES): tag(8, BYTES),
    tag(FeatureType.ROAD_LINE, BYTES): LINE,
    tag(FeatureType.ROAD_EDGE, BYTES): LINE,
    tag(FeatureType.STOP_SIGN, BYTES): LINE,
    tag(FeatureType.CROSSWALK, BYTES): OUTLINE,
    tag(FeatureType.SPEED_BUMP, BYTES): OUTLINE,
    tag(FeatureType.DRIVEWAY, BYTES): OUTLINE,
}
GOALS = {"scenes_per_s_per_core": 25.0, "bytes_over_raw": 0.3333, "peak_rss_mib": 1024}
NEIGHBOURS = (tag(11, BYTES), tag(12, BYTES))


def main() -> None:
    """Measure, print a table, and last one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("records", nargs="*", help="TFRecords; shared or built-in ones")
    urls = parser.parse_args().records or default_records()
    ways: tuple[Callable[[Record], object], ...] = (skip, walk_record, scene_or_bad_record)
    seconds = [cpu_s(partial(read, urls, way)) for way in ways]
    ingest(urls[:1])  # What is imported on the way is not counted.
    reports: list[Report] = []
    seconds.append(cpu_s(lambda: reports.extend(ingest(urls))))
    others = measure_others()
    totals = {name: sum(int(r[name]) for r in reports) for name in TOTALS}
    report(totals, seconds, others)


def measure_others() -> dict[str, dict[str, float]]:
    """Ingest the shared scenes of other sources, and say how fast and how large."""
    found: dict[str, dict[str, float]] = {}
    for folder in OTHERS if SHARED.is_dir() else ():
        with tempfile.TemporaryDirectory(prefix="infgen-bench-") as root:
            sources = find_sources([str(SHARED.parent / folder)], Root(Path(root)))
            units = STAGE.plan(_Files(sources), IngestSettings())
            reports: list[Report] = []
            spent_s = cpu_s(partial(_ingest_units, units, Path(root), reports))
        totals = {name: sum(int(r[name]) for r in reports) for name in TOTALS}
        found[folder] = {
            "scenes": totals["scenes"],
            "scenes_per_s_per_core": round(totals["scenes"] / spent_s, 1),
            "bytes_over_raw": round(totals["disk_bytes"] / totals["record_bytes"], 4),
        }
    return found


class _Files:
    """Inputs of a stage that reads only source files."""

    def __init__(self, sources: Sequence[Source]) -> None:
        self.sources = sources

    def units(self, stage: str) -> Sequence[FinishedUnit]:
        """There are no stages before this one."""
        return ()

    def folder(self, stage: str) -> Path:
        """There are no stages before this one."""
        raise KeyError(stage)

    def key(self, stage: str) -> str:
        """There are no stages before this one."""
        raise KeyError(stage)

    def content(self, stage: str, *names: str) -> str:
        """There are no stages before this one."""
        raise KeyError(stage)


def _ingest_units(units: Sequence[Unit], root: Path, reports: list[Report]) -> None:
    for unit in units:
        reports.append(STAGE.work(unit, root / unit.name, IngestSettings(), no_progress))


def default_records() -> list[str]:
    """All shared records; the built-in ones where there are none."""
    folder = SHARED if SHARED.is_dir() else BUILTIN
    return sorted(map(str, folder.glob("*.tfrecord*")))


def read(urls: Sequence[str], use: Callable[[Record], object]) -> None:
    """Stream all records and do one thing with each."""
    for url in urls:
        for record in iter_records(url):
            if isinstance(record, Record):
                use(record)


def ingest(urls: Sequence[str]) -> list[Report]:
    """Ingest files as the stage does, one after the other."""
    with tempfile.TemporaryDirectory(prefix="infgen-bench-") as folder:
        return [
            STAGE.work(
                Unit(Path(url).name, {"source": fingerprint(Path(url))}, {"url": url}),
                Path(folder) / str(number),
                IngestSettings(),
                no_progress,
            )
            for number, url in enumerate(urls)
        ]


def skip(record: Record) -> None:
    """Do nothing: what remains is to read, gunzip and check."""


def walk_record(record: Record) -> None:
    """Find where every message of a record lies, and no more."""
    data, spans = record.data, Spans()
    for field in wire.walk(data, 0, len(data)):
        if field.tag == TRACK:
            wire.split(data, field.start, field.end, tag(3, BYTES), spans)
        elif field.tag == DYNAMIC_STATE:
            wire.split(data, field.start, field.end, tag(1, BYTES), spans)
        elif field.tag == FEATURE:
            walk_feature(data, field, spans)


def walk_feature(data: bytes, feature: wire.Field, spans: Spans) -> None:
    """Walk one map feature down to its points and neighbours."""
    for part in wire.walk(data, feature.start, feature.end):
        if part.tag not in POINTS:
            continue
        for field in wire.split(data, part.start, part.end, POINTS[part.tag], spans):
            if field.tag in NEIGHBOURS:
                wire.split(data, field.start, field.end, tag(6, BYTES), spans)


def cpu_s(work: Callable[[], object]) -> float:
    """CPU-seconds, user and system, of this process and its children."""
    before = spent_s()
    work()
    return spent_s() - before


def spent_s() -> float:
    """CPU-seconds that this process and its children have spent."""
    usages = [
        resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    ]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def no_progress(done: float, total: float, note: str = "") -> None:
    """Say nothing."""


def report(
    totals: dict[str, int],
    seconds: Sequence[float],
    others: dict[str, dict[str, float]],
) -> None:
    """Print the table and the line of JSON."""
    scenes, raw_mb = max(1, totals["scenes"]), totals["record_bytes"] / 1e6
    steps = (
        "gunzip and checksums",
        "... and walk every message (the floor)",
        "... and decode to scenes",
        "the whole stage, on disk",
    )
    print(f"{'CPU time per scene':42}{'ms':>8}{'MB/s':>8}")
    for step, spent_s in zip(steps, seconds, strict=True):
        print(f"{step:42}{1e3 * spent_s / scenes:8.1f}{raw_mb / spent_s:8.0f}")
    for name, of in others.items():
        rate, share = of["scenes_per_s_per_core"], of["bytes_over_raw"]
        print(
            f"{name:42}{1e3 / rate:8.1f}   {share:.2f} of the bytes, {of['scenes']} scenes"
        )
    figures = {
        "scenes_per_s_per_core": round(scenes / seconds[-1], 1),
        "bytes_over_raw": round(totals["disk_bytes"] / (1e6 * raw_mb), 4),
        "peak_rss_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        "floor_ratio": round(seconds[-1] / seconds[1], 2),
        "goals": {
            "scenes_per_s_per_core": 25,
            "bytes_over_raw": 0.3333,
            "peak_rss_mib": 1024,
        },
        **totals,
        "others": others,
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
