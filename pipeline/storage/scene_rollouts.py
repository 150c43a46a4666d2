"""A scene and its rollouts: found in a root by the start of its id, or in records."""

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from infgen.errors import ConfigError
from infgen.scene import Scene
from pipeline.engine.layout import Root
from pipeline.engine.manifest import read_manifest
from pipeline.storage.rollouts import read_rollouts
from pipeline.storage.saved_rollouts import read_saved
from pipeline.storage.sources.raw_scenes import iter_raw_scenes
from pipeline.storage.sources.source_files import find_records

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


def find_in_root(
    root: Root,
    prefix: str,
    rollouts: Sequence[int] | None,
    most: int | None = MOST_ROLLOUTS,
) -> Seen:
    """Find a scene of a root, and rollouts of it.

    Args:
        root: Of the experiment.
        prefix: Start of the scene's id; empty for the first there is.
        rollouts: Indices; None for the first few, if there are any.
        most: How many are a few; None for all.

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
    folder = _unit_folder(root, "rollout", played, units[scenario_id])
    found = _choose_rollouts(read_rollouts(folder), scenario_id, rollouts, most)
    return Seen(_find_log(root, scenario_id), found)


def find_in_saved(folder: Path, prefix: str, rollouts: Sequence[int] | None) -> Seen:
    """Find rollouts of a folder of saved ones, and their scene.

    Args:
        folder: That ``SceneRollouts.save`` wrote.
        prefix: Start of the scene's id, or nothing.
        rollouts: Indices; None for the first few.

    Raises:
        ConfigError: if there is no such scene or rollout, naming some that there are.
    """
    saved = read_saved(folder)
    scenario_id = choose([saved.scene.scenario_id], prefix, str(folder))
    return Seen(
        saved.scene,
        _choose_rollouts(saved.rollouts, scenario_id, rollouts, MOST_ROLLOUTS),
    )


def find_in_records(patterns: Sequence[str], prefix: str) -> Scene:
    """Find the first log in records or scene files whose id starts so.

    Raises:
        ConfigError: if there is none, naming some that there are.
    """
    passed: list[str] = []
    bad: list[str] = []
    for raw in iter_raw_scenes(find_records(patterns), bad):
        if raw.scenario_id.startswith(prefix):
            return raw.decode()
        passed.append(raw.scenario_id)
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


def _choose_rollouts(
    rollouts: "Iterable[Rollout]",
    scenario_id: str,
    asked: Sequence[int] | None,
    most: int | None,
) -> "tuple[Rollout, ...]":
    """Pick rollouts of a scene by index, or the first few."""
    found: dict[int, Rollout] = {}
    for rollout in rollouts:
        if rollout.scenario_id == scenario_id:
            found[rollout.index] = rollout
        elif found:
            break  # Those of a scene lie together.
    wanted = sorted(found)[:most] if asked is None else list(dict.fromkeys(asked))
    missing = [index for index in wanted if index not in found]
    if missing:
        there = ", ".join(str(index) for index in sorted(found))
        raise ConfigError(
            f"scene {scenario_id} has no rollout {missing[0]}; there is {there}"
        )
    return tuple(found[index] for index in wanted)
