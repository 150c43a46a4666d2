"""Splits, told by file names: ``training.tfrecord-00000-of-01000`` is of ``training``."""

from collections.abc import Sequence
from itertools import accumulate, pairwise

import numpy as np

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


def spread(files: Sequence[Done], most: int) -> list[list[int]]:
    """Choose scenes of ingested files, evenly spread over all of them.

    Neighbours in a file may be alike: views of one town, cuts of one drive.

    Args:
        files: Of one split, in order.
        most: How many scenes to choose; 0 for all.

    Returns:
        For each file the rows of its scenes, ascending.
    """
    counts = [int(done.report["scenes"]) for done in files]
    total = sum(counts)
    chosen = np.arange(total)
    if 0 < most < total:
        chosen = np.arange(most) * total // most
    ends = accumulate(counts, initial=0)
    return [
        (chosen[(chosen >= begin) & (chosen < end)] - begin).tolist()
        for begin, end in pairwise(ends)
    ]
