"""Pictures of an environment, painted as videos are (extra ``video``)."""

from typing import Final

import numpy as np
from jaxtyping import UInt8

from infgen.environment.batch import DrivingBatch
from infgen.environment.scenes import DrivingScene
from infgen.rollout.population import EGO_ROW
from infgen.views.scene.agent_marks import AgentMarks
from infgen.views.scene.drawn_map import DrawnMap, Lights, draw_map, find_lights
from infgen.views.scene.map_marks import light_marks, map_marks
from infgen.views.scene.style import LIGHT
from infgen.views.scene.view import view_of
from infgen.views.scene.view_model import Role, Showing
from infgen.views.video.painter import Canvas

RENDER_MODES: Final = ("rgb_array",)
SIDE_PX = 480


class Renderer:
    """Paints environments; what it knows of a map is kept while the map is painted."""

    def __init__(self, mode: str) -> None:
        """Check the mode.

        Raises:
            ValueError: if there is no such mode.
        """
        if mode not in RENDER_MODES:
            raise ValueError(f"render_mode is {mode!r}; expected 'rgb_array' or None")
        self._drawn: dict[str, tuple[DrivingScene, DrawnMap, Lights]] = {}

    def paint(
        self, batch: DrivingBatch, environment: int
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Paint one environment, north up, the ego in the middle."""
        driven = batch.episodes.scenes[environment]
        drawn_map, lights = self._draw(driven, batch)
        showing = _showing(batch, environment)
        view = view_of(showing, 0.0, float(SIDE_PX), float(SIDE_PX))
        canvas = Canvas.plain(SIDE_PX, SIDE_PX, LIGHT.ground)
        canvas.paint(map_marks(drawn_map, view, LIGHT))
        canvas.paint(light_marks(lights, float(driven.scene.now), view, LIGHT))
        canvas.paint(AgentMarks(showing).marks(0, 0.0, view, LIGHT))
        return canvas.pixels

    def _draw(self, driven: DrivingScene, batch: DrivingBatch) -> tuple[DrawnMap, Lights]:
        name = driven.scene.scenario_id
        if name not in self._drawn or self._drawn[name][0] is not driven:
            running = {one.scene.scenario_id for one in batch.episodes.scenes}
            self._drawn = {n: kept for n, kept in self._drawn.items() if n in running}
            scene = driven.scene
            self._drawn[name] = driven, draw_map(scene.road_map), find_lights(scene)
        return self._drawn[name][1:]


def _showing(batch: DrivingBatch, environment: int) -> Showing:
    """Show one moment."""
    agents = batch.world.agents
    rows = np.flatnonzero(agents.there[environment])
    ego = int(np.flatnonzero(rows == EGO_ROW)[0])
    role = np.full(len(rows), Role.INITIAL, dtype=np.int8)
    role[ego] = Role.EGO
    return Showing(
        name=batch.episodes.scenes[environment].scene.scenario_id,
        ego=ego,
        id=rows.astype(np.int32),
        agent_type=agents.agent_type[environment, rows],
        role=role,
        size_lw_m=agents.size_lwh_m[environment, rows, :2],
        pose=agents.pose[environment, rows, None],
        valid=np.ones((len(rows), 1), dtype=bool),
        last_step=np.ones(len(rows), dtype=np.int16),
    )
