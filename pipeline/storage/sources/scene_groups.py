"""Scene files in groups: the sources that stage ``ingest`` cuts its work by.

Argoverse 2 and ScenarioNet keep a scene in a folder or a file of its own, a hundred
thousand of them. A group is as much work as a TFRecord. Which group a scene is in follows
from its name alone, so that new scenes change few groups.
"""

import hashlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from infgen.sources.registry import FoundScene
from infgen.sources.scene_files import SceneFiles
from pipeline.engine.stage import Source
from pipeline.storage.sources.fingerprints import FingerprintCache
from pipeline.storage.splits import group_name

SCENES_PER_GROUP = 64
"""Scenes of a group, on average: there are as many groups of a split as the next power of
two that makes it so."""


def group_scenes(found: Iterable[FoundScene], memory: FingerprintCache) -> list[Source]:
    """Put scenes into groups of one source and split each.

    The identity of a group is that of all names and bytes in it.
    """
    by_split: dict[tuple[str, str], list[FoundScene]] = defaultdict(list)
    for scene in found:
        by_split[memory.label(scene).split, scene.source].append(scene)
    return [
        group
        for (split, source), scenes in sorted(by_split.items())
        for group in _groups(split, source, scenes, memory)
    ]


def scene_of(part: Mapping[str, Any]) -> FoundScene:
    """Return a scene of a group, from one of its parts."""
    return FoundScene(part["source"], SceneFiles(part["name"], tuple(part["paths"])))


def _groups(
    split: str, source: str, scenes: list[FoundScene], memory: FingerprintCache
) -> Iterator[Source]:
    count = 1
    while len(scenes) > count * SCENES_PER_GROUP:
        count *= 2
    groups: dict[int, list[FoundScene]] = defaultdict(list)
    for scene in scenes:
        groups[_hash(scene.files.name) % count].append(scene)
    for number, members in sorted(groups.items()):
        members.sort(key=lambda scene: (scene.files.name, scene.files.paths))
        yield Source(
            url=members[0].files.paths[0],
            name=group_name(split, source, number, count),
            fingerprint=fingerprint_group(members, memory.fingerprint),
            parts=tuple(_part(scene) for scene in members),
        )


def fingerprint_group(
    members: Iterable[FoundScene], fingerprint: Callable[[str], str]
) -> str:
    """Return the identity of a group: that of all names and bytes in it, in order."""
    digest = hashlib.sha256()
    for scene in members:
        marks = [fingerprint(path) for path in scene.files.paths]
        digest.update(repr((scene.files.name, marks)).encode())
    return f"scenes:{digest.hexdigest()}"


def _part(scene: FoundScene) -> dict[str, Any]:
    files = scene.files
    return {"source": scene.source, "name": files.name, "paths": list(files.paths)}


def _hash(name: str) -> int:
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
