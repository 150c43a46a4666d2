"""A submission to the Waymo Open Sim Agents Challenge: shards, then one archive of them.

A shard is the unit that a killed run has finished or not. The archive is the same bytes
whenever and wherever it is packed: its members are in order and carry no times or owners.
"""

import gzip
import os
import shutil
import tarfile
from collections.abc import Iterator, Sequence
from dataclasses import fields
from itertools import islice
from pathlib import Path

from infgen.errors import ConfigError
from infgen.exports.wosac import HOW, About, complete, encode_about, encode_futures
from infgen.metrics.wosac.rollouts import RolloutsError
from infgen.metrics.wosac.submission import NUM_ROLLOUTS
from infgen.settings import build
from pipeline.commands.export_job import (
    Exported,
    Order,
    Part,
    Steps,
    Unit,
    begin,
    not_simulated,
    parts_of,
)
from pipeline.engine import signals
from pipeline.engine.atomic import PARTIAL, sync_folder, write_json
from pipeline.engine.layout import Root, read_json
from pipeline.engine.manifest import read_manifest
from pipeline.settings.lined_yaml import load

ARCHIVE = "submission.tar.gz"
COMPRESSION = 1
"""Of the archive. Level 6 takes twice as long and saves a thousandth."""
_ENDINGS = (".tar.gz", ".tgz")


def read_description(path: Path, root: Root) -> About:
    """Read the description of a submission from YAML; the root knows its parameters.

    Raises:
        ConfigError: naming the file and the field that is unknown, wrong or missing.
    """
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; expected {_asked()}")
    values = load(path)
    about = build(About, values, {name: f"{values.where(name)}: about" for name in values})
    trained = root.latest_folder("train")
    count = read_manifest(trained)["report"].get("parameters") if trained else None
    return about.with_parameters(count) if count else about


def _needed() -> list[str]:
    """Required fields of a submission."""
    return [f.name for f in fields(About)][:4]


def _asked() -> str:
    return f"YAML with {', '.join(_needed())}"


def export_submission(order: Order, units: Sequence[Unit], steps: Steps) -> Exported:
    """Check every scene, write the shards and pack them.

    Raises:
        ConfigError: if the description is missing, or ``out`` names no archive.
        RolloutsError: naming the first scene that is not as it must be.
        LockedError: if another process writes there.
    """
    about = order.about
    if about is None or not about.num_model_parameters:
        what = "who submits what" if about is None else "num_model_parameters"
        raise ConfigError(f"a submission tells {what}: name a file with --about")
    if not order.out.name.endswith(_ENDINGS):
        raise ConfigError(f"--out {order.out}: expected a name ending in {_ENDINGS[0]}")
    _check_counts(units)
    with begin(order, units):
        count = -(-steps.total // order.scenes_per_shard)
        paths = [order.partial / _shard_name(shard, count) for shard in range(count)]
        made = sum(1 for path in paths if path.is_file())  # In order: the first so many.
        before = min(made * order.scenes_per_shard, steps.total)
        steps.take(before)
        parts = _scenes(units, before)
        for path in paths[made:]:
            _write_shard(path, islice(parts, order.scenes_per_shard), order, about, steps)
        tallies = [read_json(_tally_of(path)) for path in paths]
        _pack(paths, order)
    return Exported(
        format=order.to,
        out=str(order.out),
        scenes=steps.total,
        rollouts=steps.total * NUM_ROLLOUTS,
        files=count,
        bytes=order.out.stat().st_size,
        before=before,
        filled={scene: n for tally in tallies for scene, n in tally["filled"].items()},
        unused=sum(unit.num_rollouts for unit in units) - steps.total * NUM_ROLLOUTS,
        not_simulated=not_simulated(order.rollouts),
    )


def _shard_name(shard: int, count: int) -> str:
    return f"submission.binproto-{shard:05d}-of-{count:05d}"


def _tally_of(path: Path) -> Path:
    """File that lists what was filled in a shard."""
    return path.with_name(f"{path.name}.json")


def _check_counts(units: Sequence[Unit]) -> None:
    """Refuse too few rollouts before anything is read."""
    few = {
        name: len(rollouts)
        for unit in units
        for name, rollouts in unit.scenes.items()
        if len(rollouts) < NUM_ROLLOUTS
    }
    if few:
        name, count = next(iter(few.items()))
        more = f", and {len(few) - 1} more scenes too few" if len(few) > 1 else ""
        raise RolloutsError(
            f"scene {name}: has {count} rollouts{more}; expected {NUM_ROLLOUTS} ({HOW})"
        )


def _scenes(units: Sequence[Unit], first: int) -> Iterator[Part]:
    """Read all scenes from the ``first`` on; units before it are not touched."""
    for unit in units:
        if first < len(unit.scenes):
            yield from islice(parts_of(unit), first, None)
        first = max(0, first - len(unit.scenes))


def _write_shard(
    path: Path, parts: Iterator[Part], order: Order, about: About, steps: Steps
) -> None:
    """Write one shard, a scene at a time, and what was filled in it."""
    partial = path.with_name(f"{path.name}{PARTIAL}")
    filled = {}
    with partial.open("wb") as file:
        for part in parts:
            futures = complete(order.logs.find(part.scenario_id), part.rollouts)
            file.write(encode_futures(futures.rollouts))
            if len(futures.filled):
                filled[part.scenario_id] = len(futures.filled)
            steps.take()
        file.write(encode_about(about))
        file.flush()
        os.fsync(file.fileno())
    write_json(_tally_of(path), {"filled": filled})
    partial.replace(path)


def _pack(shards: Sequence[Path], order: Order) -> None:
    """Pack the shards; the archive gets its name when all is on disk."""
    partial = order.partial / ARCHIVE
    with partial.open("wb") as file:
        with (
            gzip.GzipFile(
                filename="", mode="wb", fileobj=file, compresslevel=COMPRESSION, mtime=0
            ) as packed,
            tarfile.open(fileobj=packed, mode="w", format=tarfile.USTAR_FORMAT) as archive,
        ):
            for shard in shards:
                member = tarfile.TarInfo(shard.name)
                member.size, member.mode = shard.stat().st_size, 0o644
                with shard.open("rb") as data:
                    archive.addfile(member, data)
                signals.raise_if_stopped()
        file.flush()
        os.fsync(file.fileno())
    with signals.uninterrupted():
        partial.replace(order.out)
        sync_folder(order.out.absolute().parent)
        shutil.rmtree(order.partial)
