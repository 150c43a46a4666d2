"""Real driving logs where they are at hand, else the built-in ones."""

from collections.abc import Iterator
from pathlib import Path

from infgen.scene import Scene
from infgen.sources.womd import iter_scenes

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared" / "data" / "womd"
BUILT_IN = ROOT / "infgen" / "sources" / "towns" / "records"


def read_split(split: str) -> Iterator[Scene]:
    """Stream the scenes of one split; records that are broken are passed over.

    Args:
        split: Start of the file names; with a slash, a pattern of paths.

    Raises:
        FileNotFoundError: if neither place has the split, or no file matches.
    """
    folder = SHARED if SHARED.is_dir() else BUILT_IN
    pattern = Path(split) if "/" in split else folder / f"{split}.tfrecord*"
    paths = sorted(pattern.parent.glob(pattern.name))
    if not paths:
        raise FileNotFoundError(f"no {pattern.name} in {pattern.parent}")
    for path in paths:
        for found in iter_scenes(path):
            if isinstance(found, Scene):
                yield found
