"""The records that come with the package: two scenes of each of some towns."""

from pathlib import Path

from infgen.sources.towns.numbering import draw_scenes
from infgen.sources.womd_write import encode_scenario, write_tfrecord

BUILTIN_SEED = 2
NUM_STEPS = 91
BUILTIN = {"training": (12, 6), "validation": (4, 4)}
"""Towns of each split that come with the package, and towns per file."""
SCENES_EACH = 2

_RECORDS = Path(__file__).parent / "records"


def builtin_records() -> list[Path]:
    """Return the files that come with the package, by name."""
    return sorted(_RECORDS.glob("*.tfrecord*"))


def write_builtin(out: Path) -> list[Path]:
    """Write the files that come with the package again.

    Raises:
        SumoError: if SUMO is missing or fails.
    """
    paths = []
    for split, (towns, per_file) in BUILTIN.items():
        count = per_file * SCENES_EACH
        starts = range(0, towns * SCENES_EACH, count)
        for shard, first in enumerate(starts):
            path = out / f"{split}.tfrecord-{shard:05d}-of-{len(starts):05d}.gz"
            scenes = draw_scenes(
                BUILTIN_SEED, split, NUM_STEPS, first, count, scenes_per_town=SCENES_EACH
            )
            write_tfrecord(path, [encode_scenario(scene) for scene in scenes])
            paths.append(path)
    return paths
