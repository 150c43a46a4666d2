"""A scene and its rollouts: found in a root by the start of its id, or in records."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from infgen.errors import ConfigError
from infgen.scene import Scene
from infgen.sources.tfrecord import BadRecord, RecordError, iter_records
from infgen.sources.womd import decode_scene, read_scenario_id
from pipeline.engine.layout import Root
from pipeline.engine.manifest import read_manifest
from pipeline.storage.source_files import find_urls

if TYPE_CHECKING:
    from infgen.rollout.rollout import Rollout

MOST_NAMED = 8
MOST_BAD = 3
"""Most unusable records that a message names."""
MOST_ROLLOUTS = 3
"""Rollouts shown by default."""


class Seen(NamedTuple):
    """A scene, and those of its rollouts that are to be shown."""

    scene: Scene
    rollouts: "tuple[Rollout, ...]"


def find_in_root(root: Root, prefix: str, rollouts: Sequence[int] | None) -> Seen:
    """Find a scene of a root, and rollouts of it.

    Args:
        root: Of the experiment.
        prefix: Start of the scene's id; empty for the first there is.
        rollouts: Indices; None for the first few, if there are any.

    Raises:
        ConfigError: if there is no such scene or rollout, naming some that there are.
    """
    played = root.latest_folder("rollout") if rollouts is None or rollouts else None
    if played is None:
        if rollouts:
            raise ConfigError(
                f"{root.path} holds no rollouts; `infgen rollout --root {root.path}` makes "
                "some, and makes what is missing before (-n: only says what)"
            )
        return Seen(_find_log(root, prefix), ())
    units = units_of_scenes(played, "unit")
    if not units or (rollouts is None and prefix and not _matching(units, prefix)):
        return Seen(_find_log(root, prefix), ())
    scenario_id = choose(units, prefix, f"the rollouts below {root.path}")
    found = _read_rollouts(root, played, units[scenario_id], scenario_id, rollouts)
    return Seen(_find_log(root, scenario_id), found)


def find_recorded(folder: Path, rollouts: Sequence[int] | None) -> Seen:
    """Read a recorded drive and its log.

    Args:
        folder: Of the recording.
        rollouts: Indices; None for all that it holds.

    Raises:
        ConfigError: if it has no such rollout.
    """
    from pipeline.storage.recordings import SCENE  # noqa: PLC0415
    from pipeline.storage.rollouts import read_rollouts  # noqa: PLC0415
    from pipeline.storage.scene_lookup import open_scene_lookup  # noqa: PLC0415

    there = {rollout.index: rollout for rollout in read_rollouts(folder)}
    first = next(iter(there.values()))
    scene = open_scene_lookup([str(folder / SCENE)]).find(first.scenario_id)
    return Seen(scene, _chosen(there, first.scenario_id, rollouts))


def find_in_records(patterns: Sequence[str], prefix: str) -> Scene:
    """Find the first log in TFRecords whose id starts so.

    Raises:
        ConfigError: if there is none, naming some that there are.
    """
    passed: list[str] = []
    bad: list[str] = []
    for scenario_id, data in readable_records(find_urls(patterns), bad):
        if scenario_id.startswith(prefix):
            return decode_scene(data)
        passed.append(scenario_id)
    if passed:
        choose(passed, prefix, "these records")
    why = "; ".join(bad[:MOST_BAD]) or "they are empty"
    raise ConfigError(f"{', '.join(patterns)}: no usable record: {why}")


def choose(ids: Iterable[str], prefix: str, where: str) -> str:
    """Return the one id that starts so; of an empty start, the first.

    Raises:
        ConfigError: if there is none, or more than one, naming some.
    """
    ids = list(dict.fromkeys(ids))
    found = ids if prefix in ids else _matching(ids, prefix)
    if prefix in ids:
        return prefix
    if len(found) == 1 or (found and not prefix):
        return found[0]
    if found:
        raise ConfigError(
            f"{len(found)} scenes of {where} have ids that start with {prefix!r}: "
            f"{_some(found)}; give more of it"
        )
    near = get_close_matches(prefix, ids, n=MOST_NAMED, cutoff=0.5) or ids
    hint = f"there is {_some(near)}" if ids else "there are none"
    raise ConfigError(f"no scene of {where} has an id that starts with {prefix!r}; {hint}")


def _matching(ids: Iterable[str], prefix: str) -> list[str]:
    return [each for each in ids if each.startswith(prefix)]


def _some(ids: Sequence[str]) -> str:
    more = len(ids) - MOST_NAMED
    return ", ".join(ids[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def readable_records(urls: Sequence[str], bad: list[str]) -> Iterator[tuple[str, bytes]]:
    """Ids and bytes of all records that can be read so far as to have one.

    Why others cannot is added to ``bad``.
    """
    for url in urls:
        for record in iter_records(url):
            try:
                if isinstance(record, BadRecord):
                    raise RecordError(record.reason)
                scenario_id = read_scenario_id(record.data)
            except RecordError as error:
                bad.append(f"{url}, record {record.number}: {error}")
                continue
            yield scenario_id, record.data


def units_of_scenes(stage: Path, column: str) -> dict[str, str]:
    """Name of the unit that holds each scene of a made stage, in order."""
    import polars as pl  # noqa: PLC0415

    index = pl.read_parquet(stage / "index.parquet", columns=["scenario_id", column])
    found: dict[str, str] = {}
    for scenario_id, unit in index.iter_rows():
        found.setdefault(scenario_id, unit)
    return found


def _unit_folder(root: Root, stage: str, made: Path, unit: str) -> Path:
    keys = {each["name"]: each["key"] for each in read_manifest(made)["units"]}
    return root.unit(stage, keys[unit])


def _find_log(root: Root, prefix: str) -> Scene:
    from pipeline.storage.scene_lookup import open_scene_lookup  # noqa: PLC0415

    made = root.latest_folder("ingest")
    if made is None:
        raise ConfigError(
            f"{root.path} holds no scenes; `infgen demo` makes some, "
            "`infgen view RECORDS.tfrecord` shows a log without a root"
        )
    units = units_of_scenes(made, "source")
    scenario_id = choose(units, prefix, str(root.path))
    folder = _unit_folder(root, "ingest", made, units[scenario_id])
    return open_scene_lookup([str(folder)]).find(scenario_id)


def _read_rollouts(
    root: Root, made: Path, unit: str, scenario_id: str, asked: Sequence[int] | None
) -> "tuple[Rollout, ...]":
    from pipeline.storage.rollouts import read_rollouts  # noqa: PLC0415

    folder = _unit_folder(root, "rollout", made, unit)
    found: dict[int, Rollout] = {}
    for rollout in read_rollouts(folder):
        if rollout.scenario_id == scenario_id:
            found[rollout.index] = rollout
        elif found:
            break  # Those of a scene lie together.
    return _chosen(found, scenario_id, asked)


def _chosen(
    found: "Mapping[int, Rollout]", scenario_id: str, asked: Sequence[int] | None
) -> "tuple[Rollout, ...]":
    wanted = sorted(found)[:MOST_ROLLOUTS] if asked is None else list(dict.fromkeys(asked))
    missing = [index for index in wanted if index not in found]
    if missing:
        there = ", ".join(str(index) for index in sorted(found))
        raise ConfigError(
            f"scene {scenario_id} has no rollout {missing[0]}; there is {there}"
        )
    return tuple(found[index] for index in wanted)
