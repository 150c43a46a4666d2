"""Splits by file names: ``training.tfrecord-00000-of-01000`` is of ``training``.

Groups of scene files are named alike: ``training.argoverse2-00000-of-00004``.
"""

import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from itertools import accumulate, pairwise

import numpy as np

from pipeline.engine.plan import PlanError
from pipeline.engine.stage import FinishedUnit
from pipeline.storage.duplicates import unique_rows

_GROUP = re.compile(r"([^.]+)\.(?!tfrecord)([a-z0-9]+)-\d{5}-of-\d{5}(?:-|$)")
TFRECORD = "tfrecord"
"""Source of what is no group of scene files."""


def group_name(split: str, source: str, number: int, count: int) -> str:
    """Name a group of scene files of one split. Inverse of ``split_of``."""
    return f"{split}.{source}-{number:05d}-of-{count:05d}"


def split_of(name: str) -> str:
    """Return the split that a file belongs to: its name up to ``.tfrecord``.

    The split of a group of scene files is its name up to that of their source. Of WOMD's
    own long names the distinctive word is used:
    ``uncompressed_scenario_training_training.tfrecord-...`` is of ``training``.
    """
    if match := _GROUP.match(name):
        return match[1]
    stem = name.split(".tfrecord")[0]
    if "scenario_" not in stem:
        return stem
    folder = stem.rsplit("scenario_", 1)[1]
    words = folder.split("_")
    half = len(words) // 2
    doubled = len(words) % 2 == 0 and words[:half] == words[half:]
    return "_".join(words[:half]) if doubled else folder


def source_of(name: str) -> str:
    """Return the source of a file: that of a group of scene files, or ``tfrecord``."""
    match = _GROUP.match(name)
    return match[2] if match else TFRECORD


def in_split(name: str, split: str) -> bool:
    """Whether a file belongs to a split, or to the part of it that one source has.

    Args:
        name: Of the file, or of a group of scene files.
        split: ``validation``; ``validation.argoverse2`` for one source's part; or a
            pattern of either, as ``*_20s``.
    """
    whole = split_of(name)
    return any(fnmatchcase(each, split) for each in (whole, f"{whole}.{source_of(name)}"))


def files_of_split(
    files: Sequence[FinishedUnit], split: str, *, to: str, setting: str
) -> list[FinishedUnit]:
    """Find the ingested files of a split that hold a scene.

    Args:
        files: Files of all splits.
        split: The split.
        to: What they are for, for the message.
        setting: What to set where there are none, for the message.

    Raises:
        PlanError: if no file is of the split, or none of them holds a usable scene.
    """
    found = [done for done in files if in_split(done.name, split)]
    if not found:
        others = ", ".join(sorted({split_of(done.name) for done in files})) or "none"
        raise PlanError(
            f"no file of split {split!r} to {to} (there is: {others}); set {setting}, or "
            "name records of that split"
        )
    if not any(done.report["scenes"] for done in found):
        raise PlanError(
            f"no scene of split {split!r} to {to}: no record of its {len(found)} files is "
            "usable; quarantine.parquet of stage 'ingest' says why"
        )
    return found


def spread_evenly(files: Sequence[FinishedUnit], most: int) -> list[list[int]]:
    """Choose scenes of ingested files, evenly spread_evenly over all of them.

    Neighbouring scenes of a file may be similar: views of one town, parts of one drive.

    Args:
        files: Of one split, in order.
        most: How many scenes to choose; 0 for all.

    Returns:
        For each file the rows of its scenes, ascending.
    """
    rows = [np.array(unique_rows(done), int) for done in files]
    counts = [len(each) for each in rows]
    total = sum(counts)
    chosen = np.arange(total)
    if 0 < most < total:
        chosen = np.arange(most) * total // most
    ends = accumulate(counts, initial=0)
    return [
        each[chosen[(chosen >= begin) & (chosen < end)] - begin].tolist()
        for each, (begin, end) in zip(rows, pairwise(ends), strict=True)
    ]
