"""Marks and words on pictures of pixels, by Pillow and aggdraw (extra ``video``).

Both come as small wheels with all they need, fonts included: pictures are the same wherever
they are painted.
"""

from collections.abc import Iterable
from functools import lru_cache
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from infgen.errors import MissingExtraError
from infgen.views.scene.marks import Mark

OPAQUE = 255


def wanted(name: str) -> ModuleType:
    """Import a package of the extra.

    Raises:
        MissingExtraError: saying how to install it.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingExtraError(
            f"pictures and videos need {name.split('.')[0]}: "
            f"pip install 'infgen[video]' ({error})"
        ) from error


class Canvas:
    """A picture that is being painted: ``pixels`` [height, width, 3] are bytes of RGB.

    It is painted in place: asking for memory anew costs more than painting.
    """

    def __init__(self, pixels: UInt8[np.ndarray, "height width 3"]) -> None:
        self.pixels = pixels
        self._drawing: Any = None

    @classmethod
    def plain(cls, width_px: int, height_px: int, colour: str) -> "Canvas":
        """Begin with one colour all over."""
        return cls(np.tile(rgb(colour), (height_px, width_px, 1)))

    def paint(self, marks: Iterable[Mark]) -> None:
        """Paint marks, the first at the bottom."""
        if self._drawing is None:
            self._drawing = wanted("aggdraw").Draw("RGB", self.pixels.shape[1::-1])
        drawing = self._drawing
        drawing.frombytes(self.pixels.tobytes())
        for mark in marks:
            flat = mark.points_px.ravel().tolist()
            alpha = round(OPAQUE * mark.alpha)
            pen = _pen(mark.line, mark.width_px, alpha) if mark.line else None
            if mark.closed:
                brush = _brush(mark.fill, alpha) if mark.fill else None
                drawing.polygon(flat, pen, brush)
            elif pen is not None and len(flat) > 2:
                drawing.line(flat, pen)
        painted = np.frombuffer(drawing.tobytes(), np.uint8)
        self.pixels[...] = painted.reshape(self.pixels.shape)

    def write(
        self,
        text: str,
        place_px: tuple[float, float],
        size_px: float,
        colour: str,
        *,
        align: float = 0.0,
        upright: bool = False,
    ) -> float:
        """Write words; returns their width.

        Args:
            text: The words.
            place_px: Where on the base line they stand.
            size_px: Of the font.
            colour: Of the words.
            align: Share of the words that is before their place.
            upright: Whether they run upwards.
        """
        mask, above = _letters(text, size_px)
        before, (x, y) = align * mask.shape[1], place_px
        if upright:
            turned = np.rot90(mask)
            self.blend(turned, round(x) - above, round(y + before) - len(turned), colour)
        else:
            self.blend(mask, round(x - before), round(y) - above, colour)
        return float(mask.shape[1])

    def blend(
        self, mask: Float32[np.ndarray, "high wide"], left: int, top: int, colour: str
    ) -> None:
        """Lay a colour over a part of the picture, as strong as a mask says."""
        height, width, _ = self.pixels.shape
        rows = slice(max(0, top), max(0, min(height, top + mask.shape[0])))
        columns = slice(max(0, left), max(0, min(width, left + mask.shape[1])))
        part = self.pixels[rows, columns]
        seen = mask[rows.start - top :, columns.start - left :]
        share = seen[: part.shape[0], : part.shape[1], None]
        self.pixels[rows, columns] = part + share * (rgb(colour) - part.astype(np.float32))

    def box(self, left: int, top: int, right: int, bottom: int, colour: str) -> None:
        """Fill a rectangle."""
        self.pixels[top:bottom, left:right] = rgb(colour)

    def put(
        self, other: UInt8[np.ndarray, "high wide 3"], left_px: int, top_px: int
    ) -> None:
        """Put another picture on it."""
        high, wide, _ = other.shape
        self.pixels[top_px : top_px + high, left_px : left_px + wide] = other


def word_width(text: str, size_px: float) -> float:
    """Width of words in pixels."""
    return float(_letters(text, size_px)[0].shape[1])


def rgb(colour: str) -> UInt8[np.ndarray, "3"]:
    """Red, green and blue of ``#rrggbb``."""
    return np.frombuffer(bytes.fromhex(colour[1:]), np.uint8)


@lru_cache(maxsize=1024)
def _pen(colour: str, width_px: float, alpha: int) -> Any:
    return wanted("aggdraw").Pen(colour, width_px, alpha)


@lru_cache(maxsize=1024)
def _brush(colour: str, alpha: int) -> Any:
    return wanted("aggdraw").Brush(colour, alpha)


@lru_cache(maxsize=512)
def _letters(text: str, size_px: float) -> tuple[Float32[np.ndarray, "high wide"], int]:
    """Words as a mask from 0 to 1, and its rows above the base line."""
    font = wanted("PIL.ImageFont").load_default(size_px)
    _, top, right, bottom = (round(edge) for edge in font.getbbox(text, anchor="ls"))
    image = wanted("PIL.Image").new("L", (max(1, right + 1), max(1, bottom - top)))
    wanted("PIL.ImageDraw").Draw(image).text((0, -top), text, OPAQUE, font, "ls")
    return np.asarray(image, np.float32) / OPAQUE, -top
