"""Which view a showing gets, and all marks of it."""

from collections.abc import Iterator

from infgen.views.scene.agent_marks import AgentMarks
from infgen.views.scene.interpolation import ego_place
from infgen.views.scene.map_marks import light_marks, map_marks
from infgen.views.scene.marks import Mark, View
from infgen.views.scene.style import FIRST_REACH_M, Theme
from infgen.views.scene.view_model import Showing, ViewModel


def view_of(
    showing: Showing, time: float, width_px: float, height_px: float, density: float = 1.0
) -> View:
    """Look at the ego; as much of the world fits as the player shows at first."""
    x_m, y_m = ego_place(showing, time).tolist()
    return View((x_m, y_m), scale_of(width_px, height_px), width_px, height_px, density)


def scale_of(width_px: float, height_px: float) -> float:
    """Pixels per metre in a window of some size."""
    return min(width_px, height_px) / 2 / FIRST_REACH_M


def all_marks(
    view_model: ViewModel, agent_marks: AgentMarks, time: float, view: View, theme: Theme
) -> Iterator[Mark]:
    """Draw the map and whoever is on it."""
    yield from map_marks(view_model.drawn_map, view, theme)
    yield from moving_marks(view_model, agent_marks, time, view, theme)


def moving_marks(
    view_model: ViewModel, agent_marks: AgentMarks, time: float, view: View, theme: Theme
) -> Iterator[Mark]:
    """Draw all that changes from moment to moment."""
    yield from light_marks(view_model.lights, time, view, theme)
    yield from agent_marks.marks(view_model.now, time, view, theme)
