"""Logged scenes by scenario id, from raw records or from an ingested store, in any order.

Only a bounded part of the scenes is in memory: rollouts come in an order of their own.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from infgen.alignment import align_to_tokens
from infgen.errors import ConfigError
from infgen.scene import Scene
from pipeline.engine.atomic import MANIFEST
from pipeline.engine.layout import KEY_DIGITS, Root
from pipeline.engine.manifest import read_manifest
from pipeline.storage.sources.raw_scenes import RawScene, iter_raw_scenes
from pipeline.storage.sources.source_files import RawRecords, find_records
from pipeline.storage.splits import in_split, split_of

if TYPE_CHECKING:
    from pipeline.storage.columns import PackedRecords

CACHE_BYTES = 256 << 20
"""Bytes of records that are kept after they were passed on the way to another."""
MAX_OPEN_GROUPS = 2
MAX_NAMED = 3


class MissingSceneError(ValueError):
    """There is no log of a scene."""


@runtime_checkable
class SceneLookup(Protocol):
    """Logged scenes by scenario id."""

    def find(self, scenario_id: str) -> Scene:
        """Return one log.

        Raises:
            MissingSceneError: if there is none.
            RecordError: if there is, but it cannot be used.
        """


class RecordLookup:
    """Scenes in raw records, read as far as needed, and read again where asked back.

    Where rollouts come in the order of the records, each record is read once, alone.
    """

    def __init__(self, records: RawRecords, cache_bytes: int = CACHE_BYTES) -> None:
        self._bad: list[str] = []
        self._unread = self._read(records)
        self._places: dict[str, RawScene] = {}
        self._ids: list[str] = []
        self._cached: dict[str, RawScene] = {}
        self._free_bytes = cache_bytes

    def scenario_ids(self, least: int | None = None) -> Sequence[str]:
        """Ids in the order of the records: at least so many, if there are, or all of them.

        Records are read as far as needed, and none is decoded.
        """
        while least is None or len(self._ids) < least:
            if next(self._unread, None) is None:
                break
        return self._ids

    def find(self, scenario_id: str) -> Scene:
        """Return one log.

        Raises:
            MissingSceneError: if there is none.
            RecordError: if there is, but it cannot be used.
            ConfigError: if no file holds any usable record.
        """
        while scenario_id not in self._places:
            if next(self._unread, None) is None:
                raise self._missing(scenario_id)
        raw = self._cached.pop(scenario_id, self._places[scenario_id])
        self._free_bytes += len(raw.data)
        return align_to_tokens(raw.decode())

    def _read(self, records: RawRecords) -> Iterator[str]:
        """Read record after record into the cache; yield ids."""
        for raw in iter_raw_scenes(records, self._bad):
            if raw.scenario_id not in self._places:
                self._places[raw.scenario_id] = raw._replace(data=b"")
                self._ids.append(raw.scenario_id)
                self._keep(raw)
                yield raw.scenario_id

    def _keep(self, raw: RawScene) -> None:
        """Cache a record, and drop the oldest ones while it is too large."""
        self._cached[raw.scenario_id] = raw
        self._free_bytes -= len(raw.data)
        while self._free_bytes < 0 and len(self._cached) > 1:
            oldest = next(iter(self._cached))
            self._free_bytes += len(self._cached.pop(oldest).data)

    def _missing(self, scenario_id: str) -> ValueError:
        bad = "; ".join(self._bad[:MAX_NAMED])
        if not self._places:
            return ConfigError(f"no usable record: {bad}")
        unusable = f" ({len(self._bad)} unusable records: {bad})" if self._bad else ""
        none = f"scene {scenario_id}: none of {len(self._places)} records holds it"
        return MissingSceneError(f"{none}{unusable}")


class StoreLookup:
    """Scenes of an ingested store, with a few groups in memory at a time."""

    def __init__(self, folders: Sequence[Path], split: str | None = None) -> None:
        import polars as pl  # noqa: PLC0415

        self._places: dict[str, tuple[Path, int]] = {}
        self._open: dict[Path, PackedRecords[Scene]] = {}
        for folder in folders:
            index = pl.read_parquet(folder / "index.parquet")
            if split is not None:
                index = index.filter(pl.col("split") == split)
            for scenario_id, group, row in index.select(_PLACE).iter_rows():
                self._places.setdefault(scenario_id, (folder / group, row))

    def scenario_ids(self, least: int | None = None) -> Sequence[str]:
        """Ids of all scenes, in the order of the store."""
        return list(self._places)

    def find(self, scenario_id: str) -> Scene:
        """Return one log.

        Raises:
            MissingSceneError: if there is none.
            StoreError: if its group is damaged.
        """
        if scenario_id not in self._places:
            none = f"none of {len(self._places)} ingested scenes has its id"
            raise MissingSceneError(f"scene {scenario_id}: {none}")
        path, row = self._places[scenario_id]
        return align_to_tokens(self._group(path)[row])

    def _group(self, path: Path) -> "PackedRecords[Scene]":
        from pipeline.storage.scenes import SCENES_SCHEMA  # noqa: PLC0415
        from pipeline.storage.zarr_store import read_records  # noqa: PLC0415

        if path not in self._open:
            while len(self._open) >= MAX_OPEN_GROUPS:
                self._open.pop(next(iter(self._open)))
            self._open[path] = read_records(path, Scene, SCENES_SCHEMA, whole=True)
        return self._open[path]


_PLACE = ("scenario_id", "group", "row")


def open_scene_lookup(names: Sequence[str]) -> SceneLookup:
    """Open raw records (paths, patterns, folders, URLs), or one folder of a store.

    A folder of saved rollouts stands for the scene beside them.

    Raises:
        ConfigError: if there is nothing by such a name, or the store holds no scenes.
    """
    if len(names) == 1 and (own := saved_scenes(Path(names[0]))) is not None:
        return StoreLookup([own])
    if len(names) == 1 and (folders := unit_folders(Path(names[0]))) is not None:
        if not any(any(folder.glob("scenes-*.zarr")) for folder in folders):
            raise ConfigError(f"{names[0]} holds no ingested scenes")
        return StoreLookup(folders)
    return RecordLookup(find_records(names))


def saved_scenes(folder: Path) -> Path | None:
    """Return the folder of the scene that lies beside saved rollouts, if there is one."""
    own = folder / "scenes"
    return own if (own / "index.parquet").is_file() else None


def open_split(names: Sequence[str], split: str | None) -> RecordLookup | StoreLookup:
    """Open the scenes of one split, or of all: raw records, an ingested folder or a root.

    Raises:
        ConfigError: if there is nothing by such a name, or no scene of the split.
    """
    folder = saved_scenes(Path(names[0])) or Path(names[0])
    if len(names) == 1 and Root(folder.absolute()).store.is_dir():
        made = Root(folder.absolute()).latest_folder("ingest")
        if made is None:
            raise ConfigError(
                f"{folder} holds no scenes; `infgen ingest --root {folder}` makes them"
            )
        folder = made
    folders = unit_folders(folder) if len(names) == 1 else None
    if folders is not None:
        store = StoreLookup(folders, split)
        if split is not None and not store.scenario_ids():
            raise _no_split(names, split, _splits(folders))
        return store
    records = find_records(names)
    return RecordLookup(records if split is None else _of_split(names, records, split))


def _of_split(names: Sequence[str], records: RawRecords, split: str) -> RawRecords:
    """Keep those of one split: TFRecords by their names, others by their labels."""
    urls = [url for url in records.urls if in_split(_file_name(url), split)]
    scenes = [scene for scene in records.scenes if scene.label.split == split]
    if not urls and not scenes:
        there = {split_of(_file_name(url)) for url in records.urls}
        raise _no_split(names, split, there | {each.label.split for each in records.scenes})
    return RawRecords(urls, scenes)


def _no_split(names: Sequence[str], split: str, there: Iterable[str]) -> ConfigError:
    some = ", ".join(sorted(there)) or "none"
    return ConfigError(f"{', '.join(names)}: no split {split!r}; there is {some}")


def _splits(folders: Sequence[Path]) -> set[str]:
    import polars as pl  # noqa: PLC0415

    paths = [folder / "index.parquet" for folder in folders]
    return {name for path in paths for name in pl.read_parquet(path)["split"]}


def _file_name(url: str) -> str:
    return url.rsplit("/", 1)[-1]


def unit_folders(folder: Path) -> list[Path] | None:
    """List the unit folders of a made stage; a unit is its own; None for other folders."""
    manifest = read_manifest(folder) if (folder / MANIFEST).is_file() else {}
    if "units" not in manifest:
        return [folder] if manifest or any(folder.glob("*.zarr")) else None
    units = folder.resolve().parent / "units"
    return [units / unit["key"][:KEY_DIGITS] for unit in manifest["units"]]
