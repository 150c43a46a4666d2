"""``infgen view``: a scene with its rollouts as a page to watch, a video or a strip.

Where nothing is named the obvious thing is shown: the first scene of the latest rollouts
with the first of them and the log; without rollouts, the first log.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from glob import has_magic
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.clock import CLOCK
from infgen.errors import ConfigError
from pipeline.api.view_files import (
    GIF_FPS,
    MP4_FPS,
    STRIPS,
    VIDEOS,
    check_ending,
    write_page,
    write_strip,
    write_video,
)
from pipeline.engine.events import Event
from pipeline.engine.layout import Root
from pipeline.storage.scenes import file_name
from pipeline.storage.sources.source_files import BUILTIN, RECORDS_IN_FOLDER

if TYPE_CHECKING:
    from infgen.views.scene.view_model import ViewModel
    from infgen.views.video.layout import Format


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is shown, and what is written of it.

    Attributes:
        root: Of the experiment.
        saved: Folder of saved rollouts to show instead, if any.
        records: TFRecords to show a log of, without any root; empty for the root's.
        scene: Start of the scene's id; empty for the first there is.
        rollouts: Indices; None for the first few.
        log: Whether the log is shown beside them.
        page: The page to write; None for one named after the scene, or for none where
            something else is written.
        video: MP4 or GIF to write, if any.
        strip: SVG or PNG to write, if any.
        width_px: Of the video.
        height_px: Of the video.
        fps: Pictures per second; None for 25, or 10 of a GIF.
        theme: Colours of video and strip: ``light`` or ``dark``.
        every_s: Seconds from picture to picture of the strip.
    """

    root: Root
    saved: Path | None = None
    records: tuple[str, ...] = ()
    scene: str = ""
    rollouts: tuple[int, ...] | None = None
    log: bool = True
    page: Path | None = None
    video: Path | None = None
    strip: Path | None = None
    width_px: int = 1920
    height_px: int = 1080
    fps: int | None = None
    theme: str = "light"
    every_s: float = 6.0

    def __post_init__(self) -> None:
        """Refuse contradictions.

        Raises:
            ConfigError: naming them.
        """
        if self.records and self.rollouts:
            raise ConfigError(
                "records hold no rollouts; leave out --rollouts or name a root"
            )
        if not self.log and (self.records or self.rollouts == ()):
            raise ConfigError("--no-log without rollouts leaves nothing to show")
        if not self.every_s >= CLOCK.step_s:
            raise ConfigError(f"--every {self.every_s}: expected {CLOCK.step_s} s or more")
        if self.video:
            check_ending(self.video, VIDEOS)
        if self.strip:
            check_ending(self.strip, STRIPS)

    @property
    def form(self) -> "Format":
        """What the video is like."""
        from infgen.views.video.layout import Format  # noqa: PLC0415

        gif = self.video is not None and self.video.suffix.lower() == ".gif"
        fps = self.fps or (GIF_FPS if gif else MP4_FPS)
        return Format(self.width_px, self.height_px, fps, self.theme)


@dataclass(frozen=True, slots=True)
class Shown:
    """What was written.

    Attributes:
        scene: Id.
        showings: Names of what is to be seen.
        files: Paths, and bytes of each.
    """

    scene: str
    showings: Sequence[str]
    files: Sequence[tuple[str, int]]

    def to_json(self) -> dict[str, Any]:
        """Everything, by name."""
        return asdict(self)


def view(wanted: Wanted, tell: Callable[[Event], None] = lambda _: None) -> Shown:
    """Find what is wanted, and write it.

    Raises:
        ConfigError: if there is no such scene or rollout.
        MissingExtraError: if a package that paints or encodes is not installed.
    """
    form = wanted.form  # Wrong words are told before any work.
    view_model = find_view_model(wanted)
    page, files = wanted.page, []
    if page is None and not (wanted.video or wanted.strip):
        page = Path(f"{file_name(view_model.scenario_id)}.html")
    if page is not None:
        files.append(write_page(view_model, page))
    if wanted.strip is not None:
        files.append(write_strip(view_model, wanted.strip, wanted.theme, wanted.every_s))
    if wanted.video is not None:
        files.append(write_video(view_model, wanted.video, form, tell))
    return Shown(
        scene=view_model.scenario_id,
        showings=[showing.name for showing in view_model.showings],
        files=[(str(path), path.stat().st_size) for path in files],
    )


def find_view_model(wanted: Wanted) -> "ViewModel":
    """Gather what is wanted of a scene.

    Raises:
        ConfigError: if there is no such scene or rollout.
    """
    from infgen.views.scene.view_model import make_view_model  # noqa: PLC0415
    from pipeline.storage.scene_rollouts import (  # noqa: PLC0415
        find_in_records,
        find_in_root,
        find_in_saved,
    )

    if wanted.records:
        return make_view_model(find_in_records(wanted.records, wanted.scene), ())
    if wanted.saved is not None:
        scene, rollouts = find_in_saved(wanted.saved, wanted.scene, wanted.rollouts)
    else:
        scene, rollouts = find_in_root(wanted.root, wanted.scene, wanted.rollouts)
    # Without rollouts there is only the log to see.
    return make_view_model(scene, rollouts, log=wanted.log or not rollouts)


def is_root(folder: Path) -> bool:
    """Whether a folder is the root of an experiment."""
    return Root(folder).store.is_dir()


def check_records(word: str) -> None:
    """Refuse a word that is neither a root, a recording nor the name of records.

    Raises:
        ConfigError: saying so.
    """
    path = Path(word)
    there = path.is_file() or (path.is_dir() and _holds_records(path))
    if not there and word != BUILTIN and "://" not in word and not has_magic(word):
        raise ConfigError(
            f"{word} is neither a root nor records; expected the --root of a run, "
            f"TFRecords, a folder of {RECORDS_IN_FOLDER}, scenes of another source, or "
            "saved rollouts"
        )


def _holds_records(folder: Path) -> bool:
    from infgen.sources.registry import find_below  # noqa: PLC0415

    if any(folder.glob(RECORDS_IN_FOLDER)):
        return True
    return next(find_below(str(folder)), None) is not None
