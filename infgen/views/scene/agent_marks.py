"""Agents, their trails, and rings around inserted agents as marks."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64

from infgen.views.scene.interpolation import Moment, moment_at
from infgen.views.scene.marks import Mark, View, near, turned
from infgen.views.scene.shapes import Shape, disc, shape_of
from infgen.views.scene.style import AGENTS, Theme
from infgen.views.scene.view_model import Role, Showing

_ROLES = {Role.EGO: "ego", Role.INITIAL: "initial", Role.INSERTED: "inserted"}
_BAND_STEPS = AGENTS.trail_steps // AGENTS.trail_bands
_BAND_ALPHAS = [
    AGENTS.trail_alpha * (1 - band / AGENTS.trail_bands) ** 1.5
    for band in range(AGENTS.trail_bands)
]
_LEAST_WAY_PX = 0.5
"""Who has moved less has no trail."""
_PING_PX = (3.0, 16.0)
"""A inserted agent's ring begins so far from its box, and grows by so much."""


class AgentMarks:
    """Everyone of a showing, with their shapes."""

    def __init__(self, showing: Showing) -> None:
        self.showing = showing
        self.shapes = [
            shape_of(int(agent_type), *size)
            for agent_type, size in zip(
                showing.agent_type, showing.size_lw_m.tolist(), strict=True
            )
        ]
        self._colours = [_ROLES[Role(role)] for role in showing.role.tolist()]

    def marks(self, now: int, time: float, view: View, theme: Theme) -> Iterator[Mark]:
        """Draw trails, agents, and rings around inserted agents.

        Args:
            now: Last step of the history: whoever is there by then is no inserted agent.
            time: In steps, whole or not.
            view: The window.
            theme: The colours.
        """
        moment = moment_at(self.showing, time)
        middles_px = view.to_px(moment.pose[:, :2])
        seen = (moment.alpha > 0) & near(middles_px, view)
        yield from self._trails(moment, time, seen, view, theme)
        for row in np.flatnonzero(seen).tolist():
            yield from self._agent(row, moment, middles_px[row], view, theme)
        since = (time - self.showing.first_step) / AGENTS.ping_steps
        new = (self.showing.first_step > now) & (since >= 0) & (since <= 1)
        for row in np.flatnonzero(seen & new).tolist():
            yield self._ping(row, float(since[row]), middles_px[row], view, theme)

    def _trails(
        self,
        moment: Moment,
        time: float,
        seen: Bool[np.ndarray, " agent"],
        view: View,
        theme: Theme,
    ) -> Iterator[Mark]:
        """Draw where everyone has been, paler the longer ago."""
        showing = self.showing
        step = min(int(time), showing.num_steps - 1)
        first = max(0, step - AGENTS.trail_steps)
        known = showing.valid[:, first : step + 1]
        ways_m = showing.pose[:, first : step + 1, :2]
        way_m = np.where(known[..., None], ways_m, moment.pose[:, None, :2])
        moved_px = np.ptp(way_m, axis=1).max(axis=1) * view.scale
        width = max(AGENTS.trail_m * view.scale, AGENTS.trail_px * view.density)
        for row in np.flatnonzero(seen & (moved_px > _LEAST_WAY_PX)).tolist():
            ends = [] if moment.ghost[row] else [moment.pose[row : row + 1, :2]]
            last = min(step, int(showing.last_step[row])) - first + 1
            gaps = np.flatnonzero(~known[row, :last])
            begin = int(gaps[-1]) + 1 if len(gaps) else 0
            way = view.to_px(np.concatenate([*ends, ways_m[row, begin:last][::-1]]))
            yield from _bands(way, getattr(theme, self._colours[row]), width)

    def _agent(
        self,
        row: int,
        moment: Moment,
        middle_px: Float64[np.ndarray, "2"],
        view: View,
        theme: Theme,
    ) -> Iterator[Mark]:
        """Draw one agent, the ego's ring or an inserted agent's dot included."""
        shape, alpha = self.shapes[row], float(moment.alpha[row])
        length_m, width_m = self.showing.size_lw_m[row].tolist()
        longest_px = max(length_m, width_m) * view.scale
        larger = max(1.0, AGENTS.least_px * view.density / longest_px)
        frame = view.scale * larger * turned(float(moment.pose[row, 2]))
        colour, line_px = self._colours[row], AGENTS.outline_px * view.density
        body = shape.body @ frame + middle_px
        if moment.ghost[row]:
            yield Mark(body, None, getattr(theme, colour), 1.5 * line_px, alpha)
            return
        if row == self.showing.ego:
            radius = AGENTS.halo * length_m * view.scale * larger
            ring = disc((0.0, 0.0), radius, 48) + middle_px
            yield Mark(ring, theme.ego, None, alpha=AGENTS.halo_alpha * alpha)
            yield Mark(ring, None, theme.ego, 1.5 * view.density, alpha)
        yield Mark(body, getattr(theme, colour), theme.outline, line_px, alpha)
        for part in self._signs(row, shape):
            yield Mark(part @ frame + middle_px, theme.outline, None, alpha=alpha)

    def _signs(self, row: int, shape: Shape) -> Iterator[Float64[np.ndarray, "point 2"]]:
        """What an agent wears, in its own frame."""
        if len(shape.mark):
            yield shape.mark
        if self.showing.role[row] == Role.INSERTED:
            back, radius = shape.dot
            yield disc((back, 0.0), radius, 14)

    def _ping(
        self,
        row: int,
        since: float,
        middle_px: Float64[np.ndarray, "2"],
        view: View,
        theme: Theme,
    ) -> Mark:
        """Draw a ring that grows and fades."""
        body = 0.6 * float(self.showing.size_lw_m[row, 0]) * view.scale
        radius = body + (_PING_PX[0] + _PING_PX[1] * since) * view.density
        ring = disc((0.0, 0.0), radius, 32) + middle_px
        colour = getattr(theme, self._colours[row])
        return Mark(ring, None, colour, 2 * view.density, 0.8 * (1 - since))


def _bands(
    way_px: Float64[np.ndarray, "point 2"], colour: str, width: float
) -> Iterator[Mark]:
    """Cut a trail, newest point first, into parts that grow pale."""
    for band, alpha in enumerate(_BAND_ALPHAS):
        part = way_px[band * _BAND_STEPS : (band + 1) * _BAND_STEPS + 1]
        if len(part) > 1:
            yield Mark(part, None, colour, width, alpha, closed=False)
