"""Frames to files: H.264 in pieces that are joined without encoding again, or a GIF.

Pieces begin with a whole picture and refer to no other piece, so that several processes
may each encode some; the bytes do not depend on how many do.
"""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from infgen.views.video.painter import rgb, wanted

CODEC = "libx264"
PIXELS = "yuv420p"
OPTIONS = {
    "preset": "veryfast",
    "crf": "20",
    "bf": "0",
    "x264-params": "sliced-threads=0:asm=SSE2,SSSE3,SSE4.2",
}
"""No picture waits for a later one (bf), so pieces follow each other without gaps.

Without AVX (asm): with it the last macroblocks of a piece's first picture are now and then
encoded in another way.
"""
GIF_COLOURS = 255
GIF_TICK_S = 0.01
"""A GIF counts time in hundredths of a second."""
_BOX_LEVELS = 8
"""Colours so near to each other may stand for each other."""


def encode_piece(
    path: Path, frames: Iterable[UInt8[np.ndarray, "height width 3"]], fps: int
) -> None:
    """Encode some frames to an MP4 of their own."""
    av = wanted("av")
    with av.open(str(path), "w", format="mp4") as file:
        stream: Any = None
        for frame in frames:
            if stream is None:
                stream = file.add_stream(CODEC, rate=fps, options=OPTIONS)
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = PIXELS
                stream.codec_context.thread_count = 1
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            # By one thread: as many as there are cores would share out each picture.
            file.mux(stream.encode(picture.reformat(format=PIXELS, threads=1)))
        if stream is not None:
            file.mux(stream.encode())


def join_pieces(
    pieces: Sequence[Path], lengths: Sequence[int], fps: int, out: Path
) -> None:
    """Join encoded pieces.

    Args:
        pieces: Their files, in order.
        lengths: Frames of each.
        fps: Frames per second.
        out: The MP4 to write; may be played while it is still being loaded.
    """
    av = wanted("av")
    with av.open(str(out), "w", format="mp4", options={"movflags": "faststart"}) as file:
        stream: Any = None
        first = 0
        for path, length in zip(pieces, lengths, strict=True):
            with av.open(str(path)) as piece:
                source = piece.streams.video[0]
                stream = stream or file.add_stream_from_template(source)
                start = round(Fraction(first, fps) / source.time_base)
                for packet in piece.demux(source):
                    if packet.dts is None:
                        continue  # The end of the piece.
                    packet.pts += start
                    packet.dts += start
                    packet.stream = stream
                    file.mux(packet)
            first += length


def gif_palette(
    samples: Sequence[UInt8[np.ndarray, "height width 3"]], kept: Sequence[str]
) -> Any:
    """Choose the colours of a GIF.

    Args:
        samples: Some of its frames: most colours are chosen by them.
        kept: Colours that mean something. Few pixels have them, so they would be lost.
    """
    image = wanted("PIL.Image")
    chosen = image.fromarray(np.concatenate(samples)).quantize(GIF_COLOURS - len(kept))
    own = np.array([rgb(colour) for colour in kept])
    others = np.array(chosen.getpalette()).reshape(-1, 3)
    # Pillow looks colours up by boxes of a few levels: one next to a kept one may be taken
    # in its place.
    apart = np.abs(others[:, None] - own).max(axis=-1)
    beside = (apart < _BOX_LEVELS).any(axis=1)
    others[beside] = own[apart[beside].argmin(axis=1)]
    palette = image.new("P", (1, 1))
    palette.putpalette(np.concatenate([own, others]).ravel().tolist())
    return palette


def to_palette(frame: UInt8[np.ndarray, "height width 3"], palette: Any) -> bytes:
    """Numbers of each pixel's nearest colour."""
    image = wanted("PIL.Image")
    flat = image.fromarray(frame).quantize(palette=palette, dither=image.Dither.NONE)
    return bytes(flat.tobytes())


def write_gif(
    out: Path, frames: Iterable[bytes], palette: Any, form: tuple[int, int, int]
) -> None:
    """Write frames of numbered colours as a GIF that repeats.

    Args:
        out: The file.
        frames: Pixels as ``to_palette`` numbers them.
        palette: What it numbered them by.
        form: Width, height and frames per second.
    """
    width, height, fps = form
    image = wanted("PIL.Image")

    def pictures() -> Iterable[Any]:
        for pixels in frames:
            picture = image.frombytes("P", (width, height), pixels)
            picture.putpalette(palette.getpalette())
            yield picture

    first, *rest = pictures()
    first.save(
        out,
        format="GIF",
        save_all=True,
        append_images=rest,
        duration=round(1 / (fps * GIF_TICK_S)) * round(1000 * GIF_TICK_S),
        loop=0,
        optimize=False,
    )


def write_png(out: Path, pixels: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write a picture."""
    wanted("PIL.Image").fromarray(pixels).save(out, format="PNG", optimize=True)
