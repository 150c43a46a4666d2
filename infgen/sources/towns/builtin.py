"""The records that come with the package: two scenes of each of some towns."""

from pathlib import Path

from infgen.sources.towns.numbering import draw_scenes
from infgen.sources.towns.variety import BASIC
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


def builtin_numbers(split: str) -> list[int]:
    """Numbers of the scenes of a split, in the order of the files."""
    towns, _ = BUILTIN[split]
    return [
        town * BASIC.scenes_per_town + at
        for town in range(towns)
        for at in range(SCENES_EACH)
    ]


def write_builtin(out: Path) -> list[Path]:
    """Write the files that come with the package again.

    Raises:
        SumoError: if SUMO is missing or fails.
    """
    paths = []
    for split, (_, per_file) in BUILTIN.items():
        numbers = builtin_numbers(split)
        starts = range(0, len(numbers), per_file * SCENES_EACH)
        for shard, start in enumerate(starts):
            path = out / f"{split}.tfrecord-{shard:05d}-of-{len(starts):05d}.gz"
            records = [
                encode_scenario(scene)
                for number in numbers[start : start + per_file * SCENES_EACH : SCENES_EACH]
                for scene in draw_scenes(
                    BUILTIN_SEED, split, NUM_STEPS, number, SCENES_EACH
                )
            ]
            write_tfrecord(path, records)
            paths.append(path)
    return paths
