"""Pictures of towns, and of real scenes below them: do they look alike?

By default scenes that come with the package above the shared real records; what is drawn
of real records stays with who drew it, as the records do::

    python benchmarks/towns_pictures.py --out sheet.png [--towns 'DIR/*'] [--real 'DIR/*']
        [--scenes 4] [--every 6] [--no-real]

Needs the extra ``video``. Every picture is 150 m wide, the recording car in its middle.
"""

import argparse
from collections.abc import Iterator, Sequence
from glob import glob
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from records import BUILT_IN, SHARED

from infgen.scene import Scene
from infgen.sources.womd import iter_scenes
from infgen.views.scene.agent_marks import AgentMarks
from infgen.views.scene.style import THEMES, Theme
from infgen.views.scene.view import all_marks, view_of
from infgen.views.scene.view_model import make_view_model
from infgen.views.video.encoding import write_png
from infgen.views.video.painter import Canvas

SIDE_PX, GAP_PX = 300, 6


def pick_scenes(pattern: str, count: int, every: int) -> list[Scene]:
    """Take every so many-th scene of some records.

    Raises:
        FileNotFoundError: if no file matches.
    """
    paths = sorted(glob(pattern))
    if not paths:
        raise FileNotFoundError(f"no file matches {pattern}")
    return list(islice(_scenes(paths), 0, count * every, every))


def _scenes(paths: Sequence[str]) -> Iterator[Scene]:
    for path in paths:
        yield from (found for found in iter_scenes(path) if isinstance(found, Scene))


def draw(scene: Scene, theme: Theme) -> UInt8[np.ndarray, "high wide 3"]:
    """Paint a scene as it is now."""
    film = make_view_model(scene, ())
    (showing,) = film.showings
    view = view_of(showing, film.now, SIDE_PX, SIDE_PX)
    canvas = Canvas.plain(SIDE_PX, SIDE_PX, theme.ground)
    canvas.paint(all_marks(film, AgentMarks(showing), film.now, view, theme))
    return canvas.pixels


def draw_sheet(
    rows: Sequence[Sequence[Scene]], theme: Theme
) -> UInt8[np.ndarray, "high wide 3"]:
    """Paint rows of scenes below each other."""
    step, across = SIDE_PX + GAP_PX, max(map(len, rows))
    sheet = Canvas.plain(across * step - GAP_PX, len(rows) * step - GAP_PX, theme.panel)
    for at, row in enumerate(rows):
        for column, scene in enumerate(row):
            sheet.put(draw(scene, theme), column * step, at * step)
    return sheet.pixels


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the sheet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--towns", default=f"{BUILT_IN}/training*")
    parser.add_argument("--real", default=f"{SHARED}/validation*")
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--every", type=int, default=6, help="take one scene of so many")
    parser.add_argument("--no-real", action="store_true")
    parser.add_argument("--theme", choices=sorted(THEMES), default="light")
    asked = parser.parse_args(arguments)
    rows = [pick_scenes(asked.towns, asked.scenes, asked.every)]
    if not asked.no_real:
        rows.append(pick_scenes(asked.real, asked.scenes, asked.every))
    write_png(asked.out, draw_sheet(rows, THEMES[asked.theme]))
    print(asked.out)


if __name__ == "__main__":
    main()
