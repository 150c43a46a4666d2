"""A view of a moment as marks: lines and filled outlines in pixels, from the bottom up.

Videos and strips are painted from the same marks, whatever they are painted with.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

REACH_M = 15.0
"""From an agent's middle to the farthest that is drawn around it."""


@dataclass(frozen=True, slots=True)
class View:
    """A window on the world, north up.

    Attributes:
        centre_m: What is in its middle.
        scale: Pixels per metre.
        width_px: Of the window.
        height_px: Of the window.
        density: Pixels of a width that is given in pixels, so that prints are not thin.
    """

    centre_m: tuple[float, float]
    scale: float
    width_px: float
    height_px: float
    density: float = 1.0

    def to_px(self, xy_m: Float[np.ndarray, "point 2"]) -> Float64[np.ndarray, "point 2"]:
        """Place points of the world in the window, y down."""
        moved = (xy_m.astype(np.float64) - self.centre_m) * (self.scale, -self.scale)
        return moved + np.array([self.width_px / 2, self.height_px / 2])

    def sees(
        self, low_m: Float32[np.ndarray, "line 2"], high_m: Float32[np.ndarray, "line 2"]
    ) -> Bool[np.ndarray, " line"]:
        """Which boxes of the world reach into the window, or nearly do."""
        half = np.array([self.width_px, self.height_px]) / 2 / self.scale + 5.0
        near = (low_m <= self.centre_m + half) & (high_m >= self.centre_m - half)
        return np.asarray(near.all(axis=1))

    def shows(self, place_px: Float64[np.ndarray, "2"], margin_px: float) -> bool:
        """Whether a place of the window's plane is in it, or nearly."""
        beyond = np.array([self.width_px, self.height_px]) + margin_px
        return bool((place_px >= -margin_px).all() and (place_px <= beyond).all())


class Mark(NamedTuple):
    """A line or an outline.

    Attributes:
        points_px: Its points.
        fill: Colour within the outline, or None.
        line: Colour along it, or None.
        width_px: Of the line.
        alpha: Opacity.
        closed: Whether the line returns to its first point.
    """

    points_px: Float64[np.ndarray, "point 2"]
    fill: str | None = None
    line: str | None = None
    width_px: float = 1.0
    alpha: float = 1.0
    closed: bool = True


def turned(heading_rad: float) -> Float64[np.ndarray, "2 2"]:
    """What points of an agent's frame are multiplied with to lie in a picture, y down."""
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return np.array([[cos, -sin], [-sin, -cos]])


def near(places_px: np.ndarray, view: View) -> Bool[np.ndarray, " agent"]:
    """Who is in the window, or so near that a part may be."""
    away = np.abs(places_px - (view.width_px / 2, view.height_px / 2))
    reach = (
        view.width_px / 2 + REACH_M * view.scale,
        view.height_px / 2 + REACH_M * view.scale,
    )
    return np.asarray((away < reach).all(axis=1))
