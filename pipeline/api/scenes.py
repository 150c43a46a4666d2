"""Scenes of records, of a root or of a folder, as a sequence that reads what is used."""

import operator
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, overload

from infgen.scene import Scene
from pipeline.storage.scene_lookup import MissingSceneError, open_split
from pipeline.storage.scene_rollouts import choose

if TYPE_CHECKING:
    from pipeline.storage.scene_lookup import RecordLookup, StoreLookup


class Scenes(Sequence[Scene]):
    """Logged scenes, each read when it is asked for.

    ``scenes[0]`` reads one scene and ``scenes[:4]`` none at all. Iteration holds one scene
    in memory at a time. The length of raw records is known once all of them were passed;
    an ingested store has an index.

    Records without a readable scenario id, and those whose id came before, are left out.
    """

    def __init__(
        self,
        lookup: "RecordLookup | StoreLookup",
        source: str,
        ids: Sequence[str] | None = None,
    ) -> None:
        self._lookup, self._source, self._ids = lookup, source, ids

    @property
    def scenario_ids(self) -> Sequence[str]:
        """Ids of all scenes, in order; of raw records all are read for it."""
        return tuple(self._known())

    def __len__(self) -> int:
        return len(self._known())

    def __iter__(self) -> Iterator[Scene]:
        at = 0
        while at < len(ids := self._known(at + 1)):
            yield self._lookup.find(ids[at])
            at += 1

    def __contains__(self, scenario_id: object) -> bool:
        """Whether there is a scene with this id."""
        return scenario_id in self._known()

    @overload
    def __getitem__(self, at: int | str) -> Scene: ...

    @overload
    def __getitem__(self, at: slice) -> "Scenes": ...

    def __getitem__(self, at: int | str | slice) -> "Scene | Scenes":
        """Return one scene, or some of them.

        Args:
            at: A number (negative from the end), a slice, or a scenario id or the start of
                one.

        Raises:
            IndexError: if there are not so many scenes.
            ConfigError: if no scene, or more than one, has an id that starts so; or if no
                record can be used.
            RecordError: if the record is no usable scene.
        """
        if isinstance(at, str):
            return self._by_id(at)
        if isinstance(at, slice):
            return Scenes(self._lookup, self._source, tuple(self._reach(at)[at]))
        number = operator.index(at)
        ids = self._known(number + 1 if number >= 0 else None)
        if not -len(ids) <= number < len(ids):
            if not ids and self._ids is None:
                self._lookup.find("")  # Says why no record can be used.
            raise IndexError(f"no scene {number}; {self._source} holds {len(ids)} scenes")
        return self._lookup.find(ids[number])

    def __repr__(self) -> str:
        return f"Scenes({self._source!r})"

    def _known(self, least: int | None = None) -> Sequence[str]:
        """Ids that are known once so many were found, or all."""
        if self._ids is not None:
            return self._ids
        return self._lookup.scenario_ids(least)

    def _reach(self, part: slice) -> Sequence[str]:
        """Ids up to the end of a slice: all, where it counts from the end."""
        ends = (part.start or 0, part.stop if part.stop is not None else -1, part.step or 1)
        return self._known(None if min(ends) < 0 else part.stop)

    def _by_id(self, prefix: str) -> Scene:
        if self._ids is None:
            try:
                return self._lookup.find(prefix)
            except MissingSceneError:
                pass  # It may be the start of one.
        return self._lookup.find(choose(self._known(), prefix, self._source))


def open_scenes(source: str | Path | Sequence[str], *, split: str | None = None) -> Scenes:
    """Open scenes without reading them.

    Args:
        source: ``"builtin"`` for the synthetic records of the package; TFRecords of WOMD
            ``Scenario`` protos by path, folder, pattern or fsspec URL; the root of a run;
            an ingested folder; or a folder that ``rollouts.save`` wrote.
        split: Only scenes of this split: the file name up to ``.tfrecord``. All if None.

    Raises:
        ConfigError: if there is nothing by such a name, or no scene of the split.
    """
    names = [str(source)] if isinstance(source, str | Path) else list(source)
    return Scenes(open_split(names, split), ", ".join(names))
