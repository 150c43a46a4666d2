"""Towns as files: TFRecords of any length, and those that come with the package."""

from pathlib import Path

from infgen.sources.towns.scenes import draw_scenes
from infgen.sources.womd_write import encode_scenario, write_tfrecord

BUILTIN_SEED = 1
BUILTIN = {"training": (24, 12), "validation": (8, 8)}
"""Scenes of each split that come with the package, and scenes per file."""

_RECORDS = Path(__file__).parent / "records"


def write_towns(
    out: Path, scenes: int, seed: int, *, split: str, scenes_per_file: int
) -> list[Path]:
    """Write synthetic scenes as WOMD records, named as WOMD names its files.

    Args:
        out: Folder to write to; made if need be.
        scenes: How many.
        seed: With the split and its number it decides a scene.
        split: First part of the file names.
        scenes_per_file: Scenes of each file but perhaps the last.

    Raises:
        ValueError: if there is nothing to write.
    """
    if scenes < 1 or scenes_per_file < 1:
        raise ValueError(f"{scenes} scenes, {scenes_per_file} per file; expected 1 or more")
    out.mkdir(parents=True, exist_ok=True)
    starts = range(0, scenes, scenes_per_file)
    paths = []
    for shard, first in enumerate(starts):
        count = min(scenes_per_file, scenes - first)
        drawn = draw_scenes(seed, split, first, count)
        path = out / f"{split}.tfrecord-{shard:05d}-of-{len(starts):05d}.gz"
        write_tfrecord(path, (encode_scenario(scene) for scene in drawn))
        paths.append(path)
    return paths


def builtin_records() -> list[Path]:
    """Return the files that come with the package, by name."""
    return sorted(_RECORDS.glob("*.tfrecord*"))


def write_builtin(out: Path) -> list[Path]:
    """Write the files that come with the package again."""
    return [
        path
        for split, (scenes, per_file) in BUILTIN.items()
        for path in write_towns(
            out, scenes, BUILTIN_SEED, split=split, scenes_per_file=per_file
        )
    ]
