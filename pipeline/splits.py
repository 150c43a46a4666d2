"""Splits, told by file names: ``training.tfrecord-00000-of-01000`` is of ``training``."""


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
