"""Pages, videos and strips of a scene, written whole or not at all.

Frames are painted and encoded by several processes, a piece of them at a time; what comes
out does not depend on how many there are.
"""

import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from infgen.errors import ConfigError
from pipeline.engine import signals
from pipeline.engine.atomic import write_file
from pipeline.engine.events import Event

if TYPE_CHECKING:
    from infgen.views.scene.view_model import ViewModel
    from infgen.views.video.layout import Format

Tell = Callable[[Event], None]

MP4_FPS, GIF_FPS = 25, 10
"""Pictures per second where none are named."""
PIECE_FRAMES = 50
PALETTE_SAMPLES = 4
VIDEOS, STRIPS = (".mp4", ".gif"), (".svg", ".png")
STRIP_SCALE = 2.0
"""Pixels of a PNG strip for each of its SVG's."""


class _Piece(NamedTuple):
    """Some frames in a row, and the file they are encoded to."""

    first: int
    length: int
    path: Path


def check_ending(path: Path, endings: Sequence[str]) -> None:
    """Refuse a name that does not say in which format to write.

    Raises:
        ConfigError: naming the endings there are.
    """
    if path.suffix.lower() not in endings:
        raise ConfigError(f"{path}: expected a name that ends in {' or '.join(endings)}")


def write_page(view_model: "ViewModel", path: Path) -> Path:
    """Write the player page of a view model."""
    from infgen.views.player import player_page  # noqa: PLC0415

    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, player_page(view_model).encode())
    return path


def write_strip(
    view_model: "ViewModel",
    path: Path,
    theme: str,
    every_s: float,
    times_s: Sequence[float] = (),
) -> Path:
    """Write a strip as SVG or PNG.

    Args:
        view_model: What is shown.
        path: The file.
        theme: ``light`` or ``dark``.
        every_s: Seconds from picture to picture.
        times_s: Seconds from now instead, where given.

    Raises:
        ConfigError: if the name ends otherwise.
        MissingExtraError: if a PNG cannot be painted.
        ValueError: if a time is not shown.
    """
    from infgen.views.scene.style import THEMES  # noqa: PLC0415
    from infgen.views.video.encoding import write_png  # noqa: PLC0415
    from infgen.views.video.strips import (  # noqa: PLC0415
        make_strip,
        strip_picture,
        strip_svg,
        strip_times,
    )

    check_ending(path, STRIPS)
    times = times_s or strip_times(view_model, every_s)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() == ".svg":
        strip = make_strip(view_model, times, THEMES[theme])
        write_file(path, strip_svg(strip, THEMES[theme]).encode())
        return path
    strip = make_strip(view_model, times, THEMES[theme], STRIP_SCALE)
    with _whole(path) as partial_path:
        write_png(partial_path, strip_picture(strip, THEMES[theme]))
    return path


def write_video(
    view_model: "ViewModel",
    path: Path,
    form: "Format",
    tell: Tell = lambda _: None,
    workers: int | None = None,
) -> Path:
    """Write a video from now to the end of the longest showing.

    Args:
        view_model: What is shown.
        path: An MP4 or a GIF.
        form: Size, speed and colours.
        tell: Hears how far it is.
        workers: Processes; as many as there are cores if None, this one alone if 0.

    Raises:
        ConfigError: if the name ends otherwise.
        MissingExtraError: if the packages that paint and encode are not installed.
    """
    from infgen.views.video.encoding import join_pieces, write_gif  # noqa: PLC0415
    from infgen.views.video.frames import num_frames  # noqa: PLC0415

    check_ending(path, VIDEOS)
    gif = path.suffix.lower() == ".gif"
    _check_packages("PIL", "aggdraw", *(() if gif else ("av",)))
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = num_frames(view_model, form)
    with tempfile.TemporaryDirectory(prefix="infgen-video-") as folder:
        pieces = [
            _Piece(first, min(PIECE_FRAMES, frames - first), Path(folder) / f"{first:06d}")
            for first in range(0, frames, PIECE_FRAMES)
        ]
        palette = _palette(view_model, form) if gif else None
        _make_pieces(
            partial(_make_piece, view_model, form, palette), pieces, frames, tell, workers
        )
        with _whole(path) as partial_path:
            if gif:
                size = form.width_px, form.height_px, form.fps
                write_gif(partial_path, _pixels(pieces, form), palette, size)
            else:
                paths, lengths = [p.path for p in pieces], [p.length for p in pieces]
                join_pieces(paths, lengths, form.fps, partial_path)
    return path


def _check_packages(*names: str) -> None:
    from infgen.views.video.painter import wanted  # noqa: PLC0415

    for name in names:
        wanted(name)


def _make_piece(
    view_model: "ViewModel", form: "Format", palette: Any, piece: _Piece
) -> int:
    """Paint and encode some frames; returns how many."""
    from infgen.views.video.encoding import encode_piece, to_palette  # noqa: PLC0415
    from infgen.views.video.frames import paint_frames  # noqa: PLC0415

    frames = paint_frames(view_model, form, piece.first, piece.length)
    if palette is None:
        encode_piece(piece.path, frames, form.fps)
    else:
        with piece.path.open("wb") as file:
            file.writelines(to_palette(frame, palette) for frame in frames)
    return piece.length


def _make_pieces(
    make: Callable[[_Piece], int],
    pieces: Sequence[_Piece],
    frames: int,
    tell: Tell,
    workers: int | None,
) -> None:
    """Make all pieces, here or by several processes, with progress events."""
    workers = len(os.sched_getaffinity(0)) if workers is None else workers
    tell(
        {"event": "work-started", "stage": "video", "units": 1, "made": 0, "what": "frames"}
    )
    done = 0
    results = map(make, pieces) if workers == 0 else _by_processes(make, pieces, workers)
    for count in results:
        done += count
        tell(
            {
                "event": "progress",
                "stage": "video",
                "done": done,
                "total": frames,
                "note": "",
            }
        )
        signals.raise_if_stopped()


def _by_processes(
    make: Callable[[_Piece], int], pieces: Sequence[_Piece], workers: int
) -> Iterator[int]:
    # Other libraries have threads here, and a fork would copy their locks in any state.
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _ignore_signals)
    try:
        waiting: list[Future[int]] = [pool.submit(make, piece) for piece in pieces]
        for future in as_completed(waiting):
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _ignore_signals() -> None:
    """A terminal interrupts all processes; the one that started the others ends them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _palette(view_model: "ViewModel", form: "Format") -> Any:
    """Choose a GIF's colours by a few frames of the whole length."""
    from infgen.views.video.encoding import gif_palette  # noqa: PLC0415
    from infgen.views.video.frames import num_frames, paint_frames  # noqa: PLC0415

    last = max(0, num_frames(view_model, form) - 1)
    places = sorted({last * at // (PALETTE_SAMPLES - 1) for at in range(PALETTE_SAMPLES)})
    samples = [next(paint_frames(view_model, form, at, 1)) for at in places]
    return gif_palette(samples, list(asdict(form.colours).values()))


def _pixels(pieces: Sequence[_Piece], form: "Format") -> Iterator[bytes]:
    for piece in pieces:
        with piece.path.open("rb") as file:
            for _ in range(piece.length):
                yield file.read(form.width_px * form.height_px)


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """Give a name to write under, and rename it when all is written."""
    partial_path = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial_path
        with partial_path.open("rb+") as file:
            os.fsync(file.fileno())
        partial_path.replace(path)
    finally:
        partial_path.unlink(missing_ok=True)
