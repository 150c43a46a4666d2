"""Roads, stop signs and traffic lights as marks."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float64

from infgen.tokens.scene_tokens import SignalClass
from infgen.views.scene.drawn_map import DrawnMap, Lights, RoadLook
from infgen.views.scene.marks import Mark, View, turned
from infgen.views.scene.shapes import disc
from infgen.views.scene.style import LIGHTS, SIGN_LEAST_PX, SIGN_M, STROKES, Stroke, Theme

_WIDE_M = 1.0
"""Wider lines have round ends."""
_SIGNALS = {
    SignalClass.STOP: "stop",
    SignalClass.CAUTION: "caution",
    SignalClass.GO: "go",
    SignalClass.UNKNOWN: "unknown",
}


def map_marks(drawn: DrawnMap, view: View, theme: Theme) -> Iterator[Mark]:
    """Draw the roads, then the stop signs on them."""
    seen = _seen_lines(drawn, view)
    for stroke in STROKES:
        wanted = seen & np.isin(drawn.look, stroke.looks)
        if not stroke.bridges:
            wanted &= ~drawn.bridge
        for row in np.flatnonzero(wanted).tolist():
            yield from _stroke_marks(view.to_px(drawn.line(row)), stroke, view, theme)
    radius = max(SIGN_M * view.scale, SIGN_LEAST_PX * view.density)
    for row in np.flatnonzero(seen & (drawn.look == RoadLook.STOP_SIGN)).tolist():
        x, y = view.to_px(drawn.line(row))[0].tolist()
        turn = np.pi / 8
        octagon = disc((0.0, 0.0), radius, 8) @ turned(turn) + (x, y)
        yield Mark(octagon, theme.sign, theme.white, 0.28 * radius)


def light_marks(lights: Lights, time: float, view: View, theme: Theme) -> Iterator[Mark]:
    """Draw traffic lights; once the log is over they are held, and pale."""
    steps = lights.state.shape[1]
    if not steps:
        return
    state = lights.state[:, min(max(0, int(time)), steps - 1)]
    alpha = LIGHTS.held_alpha if time > steps - 1 else 1.0
    size = max(LIGHTS.size_m * view.scale, LIGHTS.least_px * view.density)
    for row in np.flatnonzero(state != SignalClass.NO_SIGNAL).tolist():
        place = view.to_px(lights.xy_m[row : row + 1])
        frame = turned(float(lights.heading_rad[row]))
        agent_type = SignalClass(state[row])
        outline = _light_outline(agent_type, size) @ frame + place
        colour = getattr(theme, _SIGNALS[agent_type])
        if agent_type is SignalClass.UNKNOWN:
            yield Mark(outline, None, colour, LIGHTS.ring * size, alpha)
        else:
            yield Mark(outline, colour, None, alpha=alpha)


def _seen_lines(drawn: DrawnMap, view: View) -> Bool[np.ndarray, " line"]:
    if not len(drawn.look):
        return np.zeros(0, bool)
    low = np.minimum.reduceat(drawn.xy_m, drawn.offsets[:-1])
    high = np.maximum.reduceat(drawn.xy_m, drawn.offsets[:-1])
    return view.sees(low, high)


def _stroke_marks(
    points_px: np.ndarray, stroke: Stroke, view: View, theme: Theme
) -> Iterator[Mark]:
    colour = getattr(theme, stroke.colour)
    if not stroke.width_m:
        yield Mark(points_px, colour)
        return
    width = max(stroke.width_m * view.scale, stroke.least_px * view.density)
    lengths = [length * view.scale for length in stroke.dash_m]
    for line in dashes(points_px, lengths) if lengths else [points_px]:
        for part in within(line, view, width):
            yield Mark(part, None, colour, width, closed=False)
    if stroke.width_m > _WIDE_M:
        for end in points_px[[0, -1]]:
            if view.shows(end, width):
                yield Mark(disc((0.0, 0.0), width / 2, 12) + end, colour)


def within(
    points_px: Float64[np.ndarray, "point 2"], view: View, margin_px: float
) -> Iterator[Float64[np.ndarray, "part 2"]]:
    """Keep the stretches of a line that may be seen; pieces are kept or left out whole."""
    low = np.minimum(points_px[:-1], points_px[1:]) - margin_px
    high = np.maximum(points_px[:-1], points_px[1:]) + margin_px
    seen = ((high >= 0) & (low <= (view.width_px, view.height_px))).all(axis=1)
    edges = np.flatnonzero(np.diff(seen.astype(np.int8), prepend=0, append=0))
    for first, end in edges.reshape(-1, 2).tolist():
        yield points_px[first : end + 1]


def dashes(
    points: Float64[np.ndarray, "point 2"], lengths: Sequence[float]
) -> Iterator[Float64[np.ndarray, "part 2"]]:
    """Cut a line into dashes: so long, with gaps so long between them."""
    if not lengths or len(points) < 2:
        return
    along = np.cumsum(np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=1))
    dash, gap = lengths
    for start in np.arange(0.0, along[-1], dash + gap).tolist():
        end = min(start + dash, float(along[-1]))
        stops = np.array([start, *along[(along > start) & (along < end)], end])
        yield np.stack(
            [np.interp(stops, along, points[:, axis]) for axis in (0, 1)], axis=-1
        )


def _light_outline(agent_type: SignalClass, size: float) -> np.ndarray:
    if agent_type is SignalClass.STOP:
        thick, half = LIGHTS.bar_thick * size / 2, LIGHTS.bar_half * size
        return np.array([(thick, half), (-thick, half), (-thick, -half), (thick, -half)])
    if agent_type is SignalClass.CAUTION:
        return disc((0.0, 0.0), LIGHTS.diamond * size, 4)
    return disc((0.0, 0.0), size)
