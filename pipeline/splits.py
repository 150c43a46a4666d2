"""Splits, told by file names: ``training.tfrecord-00000-of-01000`` is of ``training``."""

from collections.abc import Sequence
from itertools import accumulate, pairwise

from pipeline.stage import Done


def split_of(name: str) -> str:
    """Return the split that a file belongs to: its name up to ``.tfrecord``.

    WOMD's own long names are cut to the word that tells:
    ``uncompressed_scenario_training_training.tfrecord-...`` is of ``training``.
    """
    stem = name.split(".tfrecord")[0]
    if "scenario_" not in stem:
        return stem
    folder = stem.rsplit("scenario_", 1)[1]
    words = folder.split("_")
    half = len(words) // 2
    doubled = len(words) % 2 == 0 and words[:half] == words[half:]
    return "_".join(words[:half]) if doubled else folder


def in_split(name: str, split: str) -> bool:
    """Tell whether a file belongs to a split."""
    return split_of(name) == split


def shares(files: Sequence[Done], most: int) -> list[int]:
    """Scenes to take of each ingested file, of all alike; all of them if ``most`` is 0."""
    counts = [int(done.report["scenes"]) for done in files]
    total = sum(counts)
    if most == 0 or most >= total:
        return counts
    ends = [end * most // total for end in accumulate(counts, initial=0)]
    return [end - begin for begin, end in pairwise(ends)]
