"""Scenes that episodes begin in: tokenized once, and kept while they are used."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Int8, Int64

from infgen.rollout.recording import RolloutStart
from infgen.rollout.simulator import Simulator
from infgen.scene import Scene
from infgen.spatial.road_edges import RoadEdges, scene_road_edges
from infgen.tokens.map import PolylineType
from infgen.tokens.scene_tokens import SceneTokens
from infgen.tokens.signals import LoggedSignals
from infgen.tokens.tokenizer import read_logged_signals, tokenize_scene

MOST_SCENES = 64
"""Scenes that are kept ready, beyond those of running episodes."""

SceneChoice = Scene | str | int | None
"""A scene, its id, its number among the scenes of the environment, or any of these."""


class SceneChoiceError(ValueError):
    """A scene that was asked for is not there."""


@dataclass(frozen=True, slots=True)
class DrivingScene:
    """A scene with all that episodes in it have in common.

    Attributes:
        start: Log and tokenized history; index and seed are those of no episode.
        edges: Road edges, in the plane; None on a map without any.
        line_pose: Where lanes with a signal begin.
        line_shown: ``SignalClass`` of their signals by the token step; the last one lasts.
    """

    start: RolloutStart
    edges: RoadEdges | None
    line_pose: Float32[np.ndarray, "line 3"]
    line_shown: Int8[np.ndarray, "line token"]

    @property
    def scene(self) -> Scene:
        """The log."""
        return self.start.scene

    @property
    def map_pose(self) -> Float32[np.ndarray, "map_token 3"]:
        """First point and heading of each map token."""
        return self.start.history.map_pose

    @property
    def map_type(self) -> Int8[np.ndarray, " map_token"]:
        """``PolylineType`` of each map token."""
        return self.start.history.map_polyline_type

    def episode(self, seed: int) -> RolloutStart:
        """Return what an episode with some seed continues."""
        return replace(self.start, seed=seed)


class SceneChooser:
    """The scenes of an environment, prepared when they are first used."""

    def __init__(
        self, simulator: Simulator, scenes: Sequence[Scene], most: int = MOST_SCENES
    ) -> None:
        """Hold scenes without looking at them.

        Raises:
            SceneChoiceError: if there are none.
        """
        if not len(scenes):
            raise SceneChoiceError("scenes is empty; give at least one scene")
        self._simulator, self._scenes, self._most = simulator, scenes, most
        self._ready: OrderedDict[int, DrivingScene] = OrderedDict()
        self._number: dict[str, int] = {}

    def choose(self, choice: SceneChoice, random: np.random.Generator) -> DrivingScene:
        """Return the chosen scene, or one that is drawn.

        Args:
            choice: Which; None draws one.
            random: One number is drawn, whatever the choice.

        Raises:
            SceneChoiceError: if there is no such scene.
            TokensError: if it cannot be simulated.
        """
        drawn = int(random.integers(len(self._scenes)))
        if choice is None:
            return self._get(drawn)
        if isinstance(choice, Scene):
            return prepare(choice, self._simulator)
        if isinstance(choice, str):
            return self._get(self._find(choice))
        number = int(choice)
        if not -len(self._scenes) <= number < len(self._scenes):
            raise SceneChoiceError(
                f"scene is {number}, but the environment has {len(self._scenes)} scenes; "
                "choose from 0 on"
            )
        return self._get(number % len(self._scenes))

    def _get(self, number: int) -> DrivingScene:
        if number not in self._ready:
            self._ready[number] = prepare(self._scenes[number], self._simulator)
        self._ready.move_to_end(number)
        while len(self._ready) > self._most:
            self._ready.popitem(last=False)
        return self._ready[number]

    def _find(self, scenario_id: str) -> int:
        while scenario_id not in self._number:
            number = len(self._number)
            if number == len(self._scenes):
                known = ", ".join(list(self._number)[:3])
                raise SceneChoiceError(
                    f"scene is {scenario_id!r}, but the ids of the {number} scenes are "
                    f"{known}, ..."
                )
            self._number.setdefault(self._scenes[number].scenario_id, number)
        return self._number[scenario_id]


def prepare(scene: Scene, simulator: Simulator) -> DrivingScene:
    """Tokenize the history of a scene, and look up what episodes need of its map.

    Raises:
        TokensError: if the scene cannot be simulated.
    """
    history = tokenize_scene(
        scene, simulator.vocabulary, simulator.roads, simulator.tokens, until=scene.now
    )
    lights = read_logged_signals(scene) if simulator.settings.signals == "log" else None
    known = lights or LoggedSignals(history.signal_polyline, history.signal_state)
    row, number = _stop_lines(history, known)
    return DrivingScene(
        start=RolloutStart(scene, history, 0, 0, lights),
        edges=scene_road_edges(scene, flat=True),
        line_pose=history.map_pose[row],
        line_shown=known.shown[number],
    )


def _stop_lines(
    history: SceneTokens, known: LoggedSignals
) -> tuple[Int64[np.ndarray, " line"], Int64[np.ndarray, " line"]]:
    """First map token of each lane with a signal, and the row of that signal."""
    first = np.ones(history.num_map_tokens, dtype=bool)
    first[1:] = np.diff(history.map_polyline) != 0
    first &= history.map_polyline_type == PolylineType.LANE
    first &= np.isin(history.map_polyline, known.polyline)
    row = np.flatnonzero(first)
    return row, np.searchsorted(known.polyline, history.map_polyline[row])
