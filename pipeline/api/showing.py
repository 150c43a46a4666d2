"""Scenes and rollouts to be looked at: pages, strips, videos."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from infgen.rollout.rollout import Rollout
from infgen.scene import Scene
from pipeline.api.view_files import GIF_FPS, MP4_FPS, write_page, write_strip, write_video
from pipeline.storage.scenes import file_name

if TYPE_CHECKING:
    from infgen.views.scene.view_model import ViewModel

FRAME_HEIGHT_PX = 620


@dataclass(frozen=True, slots=True)
class PlayerPage(os.PathLike[str]):
    """A page that plays rollouts in any browser and loads nothing from elsewhere.

    Attributes:
        path: The file.
    """

    path: Path

    def __fspath__(self) -> str:
        return str(self.path)

    def __str__(self) -> str:
        return str(self.path)

    def _repr_html_(self) -> str:
        """Show the page in a notebook, in a frame of its own, without the file."""
        page = escape(self.path.read_text(encoding="utf-8"))
        return (
            f'<iframe srcdoc="{page}" width="100%" height="{FRAME_HEIGHT_PX}" '
            'style="border:0"></iframe>'
        )


def show_page(
    scene: Scene, rollouts: Sequence[Rollout], path: str | Path | None, *, log: bool
) -> PlayerPage:
    """Write a player page."""
    target = Path(f"{file_name(scene.scenario_id)}.html" if path is None else path)
    return PlayerPage(write_page(_view_model(scene, rollouts, log=log), target))


def show_strip(
    scene: Scene, rollouts: Sequence[Rollout], path: Path, every_s: float, *, log: bool
) -> Path:
    """Write moments side by side."""
    return write_strip(_view_model(scene, rollouts, log=log), path, "light", every_s)


def show_video(
    scene: Scene,
    rollouts: Sequence[Rollout],
    path: Path,
    size_px: tuple[int, int],
    *,
    log: bool,
    workers: int,
) -> Path:
    """Write a video."""
    from infgen.views.video.layout import Format  # noqa: PLC0415  # Takes 0.3 s.

    fps = GIF_FPS if path.suffix.lower() == ".gif" else MP4_FPS
    form = Format(*size_px, fps)
    return write_video(_view_model(scene, rollouts, log=log), path, form, workers=workers)


def _view_model(scene: Scene, rollouts: Sequence[Rollout], *, log: bool) -> "ViewModel":
    from infgen.views.scene.view_model import make_view_model  # noqa: PLC0415

    return make_view_model(scene, tuple(rollouts), log=log)
