"""Source files: found by path, pattern or URL.

A path may name WOMD's TFRecords, or scenes of other sources: their files, their folders or
any folder above. What a file is follows from its content.
"""

import glob
import os
from collections import defaultdict
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from infgen.errors import ConfigError
from infgen.sources.remote import file_system
from pipeline.engine.layout import Root
from pipeline.engine.stage import Source
from pipeline.storage.sources.fingerprints import FingerprintCache

if TYPE_CHECKING:
    from infgen.sources.registry import FoundScene

BUILTIN = "builtin"
"""Names the synthetic records of the package."""
RECORDS_IN_FOLDER = "*.tfrecord*"
PICKLES = (".pkl", ".pickle")
"""Ends of names of scene files that were converted from TFRecords and may be named so."""


class RawRecords(NamedTuple):
    """What some patterns name.

    Attributes:
        urls: Of TFRecords, in order.
        scenes: Scene files of other sources, in order.
    """

    urls: list[str]
    scenes: "list[FoundScene]"


def find_sources(patterns: Sequence[str], root: Root) -> tuple[Source, ...]:
    """Find source files and their identities, in the order of their names.

    Args:
        patterns: Paths, folders, glob patterns, fsspec URLs, or ``builtin``.
        root: Root that caches identities.

    Raises:
        ConfigError: if a pattern matches nothing, or two files have one name.
    """
    if not patterns:
        raise ConfigError("no records are named; --records 'DIR/*.tfrecord*' names them")
    urls, scenes = find_records(patterns)
    _refuse_equal_names(urls)
    memory = FingerprintCache(root)
    found = [Source(url, _name(url), memory.fingerprint(url)) for url in urls]
    if scenes:
        from pipeline.storage.sources.scene_groups import group_scenes  # noqa: PLC0415

        found += group_scenes(scenes, memory)
    memory.save()
    return tuple(sorted(found, key=lambda source: source.name))


def find_records(patterns: Sequence[str]) -> RawRecords:
    """Find files by path, folder, pattern or URL, each once, in order.

    Raises:
        ConfigError: if a pattern matches nothing.
    """
    urls: set[str] = set()
    scenes: set[FoundScene] = set()
    for pattern in patterns:
        found = _matches(pattern)
        urls.update(found.urls)
        scenes.update(found.scenes)
    return RawRecords(sorted(urls), sorted(scenes, key=_order))


def _order(scene: "FoundScene") -> tuple[str, str, tuple[str, ...]]:
    return scene.source, scene.files.name, scene.files.paths


def absolute(pattern: str) -> str:
    """Make a local path or pattern independent of the current folder."""
    pattern = pattern.removeprefix("file://")
    if "://" in pattern or pattern == BUILTIN:
        return pattern
    return os.path.abspath(os.path.expanduser(pattern))


def _matches(pattern: str) -> RawRecords:
    if pattern == BUILTIN:
        from infgen.sources.towns import builtin_records  # noqa: PLC0415

        return RawRecords([str(path) for path in builtin_records()], [])
    found = _remote(pattern) if "://" in pattern else _local(absolute(pattern))
    if not found.urls and not found.scenes:
        raise ConfigError(
            f"no records match {pattern}; expected TFRecord files of WOMD Scenario protos, "
            "as --records 'DIR/*.tfrecord*' or the variable INFGEN_RECORDS names them, or "
            "folders or files of Argoverse 2 or ScenarioNet"
        )
    return found


def _local(pattern: str) -> RawRecords:
    named = os.path.exists(pattern)
    paths = [pattern] if named else sorted(glob.glob(pattern, recursive=True))
    files = [path for path in paths if os.path.isfile(path)]
    folders = [path for path in paths if os.path.isdir(path)]
    found = _in_files(files)
    for folder in folders:
        inner = _in_folder(folder, records=named)
        found = RawRecords([*found.urls, *inner.urls], [*found.scenes, *inner.scenes])
    return found


def _in_folder(folder: str, *, records: bool) -> RawRecords:
    """Find TFRecords in a folder, and scenes of other sources in it and below."""
    from infgen.sources.registry import find_below, is_tfrecord  # noqa: PLC0415

    inside = glob.glob(os.path.join(glob.escape(folder), RECORDS_IN_FOLDER))
    urls = [path for path in inside if os.path.isfile(path) and is_tfrecord(Path(path))]
    return RawRecords(urls if records else [], list(find_below(folder)))


def _in_files(paths: Iterable[str]) -> RawRecords:
    """Tell scene files from others by their content; others are taken for TFRecords."""
    from infgen.sources.registry import find_in, is_scene_table, is_tfrecord  # noqa: PLC0415

    @cache
    def scenes_in(folder: str) -> dict[str, "FoundScene"]:
        names = [each.name for each in os.scandir(folder) if each.is_file()]
        scenes = find_in(folder, names)
        return {path: scene for scene in scenes for path in scene.files.paths}

    found = RawRecords([], [])
    for path in paths:
        scene = None
        if not is_tfrecord(Path(path)):
            scene = scenes_in(os.path.dirname(path)).get(path)
        if scene is not None:
            found.scenes.append(scene)
        elif not is_scene_table(Path(path)):
            found.urls.append(path)
    return found


def _remote(pattern: str) -> RawRecords:
    """Find TFRecords and scenes by URL, as local ones are found."""
    system, path = file_system(pattern)
    kinds: dict[str, str] = {}
    if named := not glob.has_magic(path):
        kinds[path] = _kind(system, path)
    else:
        entries = system.glob(path, detail=True)
        kinds = {found: entry["type"] for found, entry in sorted(entries.items())}
    urls = {found: str(system.unstrip_protocol(found)) for found in kinds}
    found = _in_urls(urls[each] for each, kind in kinds.items() if kind == "file")
    for folder in (each for each, kind in kinds.items() if kind == "directory"):
        from infgen.sources.remote_scenes import find_below_url  # noqa: PLC0415

        inside = system.glob(f"{folder.rstrip('/')}/{RECORDS_IN_FOLDER}") if named else ()
        records = [str(system.unstrip_protocol(each)) for each in inside]
        found.urls.extend(url for url in records if _names_tfrecord(url))
        found.scenes.extend(find_below_url(urls[folder]))
    return found


def _kind(system: Any, path: str) -> str:
    if system.isfile(path):
        return "file"
    return "directory" if system.isdir(path) else "nothing"


def _in_urls(urls: Iterable[str]) -> RawRecords:
    """Tell scene files from others; others are taken for TFRecords."""
    from infgen.sources.remote_scenes import find_in_url  # noqa: PLC0415

    @cache
    def scenes_in(folder: str) -> dict[str, "FoundScene"]:
        return {path: one for one in find_in_url(folder) for path in one.files.paths}

    found = RawRecords([], [])
    for url in urls:
        if _names_tfrecord(url):
            found.urls.append(url)
        elif scene := scenes_in(url.rsplit("/", 1)[0]).get(url):
            found.scenes.append(scene)
        elif not url.endswith(PICKLES):
            found.urls.append(url)
    return found


def _names_tfrecord(url: str) -> bool:
    """Whether a URL is named as a TFRecord, which need not be opened to be told."""
    return ".tfrecord" in _name(url) and not url.endswith(PICKLES)


def _name(url: str) -> str:
    return url.rsplit("/", 1)[-1]


def _refuse_equal_names(urls: Sequence[str]) -> None:
    by_name = defaultdict(list)
    for url in urls:
        by_name[_name(url)].append(url)
    for name, twins in by_name.items():
        if len(twins) > 1:
            raise ConfigError(
                f"two source files are named {name}: {twins[0]} and {twins[1]}; rename one"
            )
