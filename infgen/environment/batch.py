"""A batch of environments: episodes that go on together and end one by one.

The single environment is a batch of one. Nothing here is of gymnasium but the spaces.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float, Float64

from infgen.clock import CLOCK
from infgen.environment.crashes import nearest_agent_m, off_road_m
from infgen.environment.ego import EgoState, action_bounds, drive
from infgen.environment.observation import (
    Observation,
    Surroundings,
    observe,
    table_spaces,
)
from infgen.environment.reward import DrivingStep
from infgen.environment.route import END_M, Route, make_route
from infgen.environment.scenes import DrivingScene, SceneChoice, SceneChooser
from infgen.environment.settings import EnvironmentSettings
from infgen.environment.world import World
from infgen.rollout.population import EGO_ROW
from infgen.rollout.simulator import Simulator
from infgen.scene import Scene

MAPS_KEPT = 64
"""Encoded maps that are kept, beyond those of running episodes."""
MAX_SEED = 2**31


@dataclass(frozen=True, slots=True)
class Spaces:
    """Observation and action space of one environment."""

    observation: spaces.Space[Any]
    action: spaces.Box

    @classmethod
    def of(cls, settings: EnvironmentSettings) -> "Spaces":
        """Return the spaces that settings ask for."""
        seen: spaces.Space[Any] = spaces.Dict(table_spaces(settings))
        if settings.observation == "flat":
            seen = spaces.flatten_space(seen)
        low, high = action_bounds(settings.action, settings.action_s)
        return cls(seen, spaces.Box(low, high))


@dataclass(frozen=True, slots=True)
class Episodes:
    """What is counted over the episode of each environment.

    Attributes:
        scenes: Where they drive.
        routes: Where to.
        steps: 0.1 s steps so far.
        along_m: Way along the route.
        off_route_m: Distance to the route.
        distance_m: Way driven.
        collisions: Collisions so far: 1 when the episode ends with one.
        was_clear: Whether the ego overlapped no agent at some step: before, overlaps come
            from the log and are no collisions.
        was_on_road: The same for the road.
    """

    scenes: tuple[DrivingScene, ...]
    routes: tuple[Route, ...]
    steps: np.ndarray
    along_m: Float64[np.ndarray, " environment"]
    off_route_m: Float64[np.ndarray, " environment"]
    distance_m: Float64[np.ndarray, " environment"]
    collisions: np.ndarray
    was_clear: Bool[np.ndarray, " environment"]
    was_on_road: Bool[np.ndarray, " environment"]


class DrivingBatch:
    """Environments that share one call of the network per token step.

    Attributes:
        ego: The driven cars.
        episodes: What is counted.
        settings: How they are driven and observed.
    """

    ego: EgoState
    episodes: Episodes

    def __init__(
        self, simulator: Simulator, scenes: Sequence[Scene], settings: EnvironmentSettings
    ) -> None:
        """Prepare; nothing is simulated before ``reset``."""
        self.settings = settings
        if settings.rules is not None:
            own = simulator.settings.with_rules(settings.rules)
            simulator = replace(simulator, settings=own)
        self._simulator, self._chooser = simulator, SceneChooser(simulator, scenes)
        self._world: World | None = None
        self._random: list[np.random.Generator] = []

    def reset(
        self, random: Sequence[np.random.Generator], choices: Sequence[SceneChoice]
    ) -> None:
        """Begin an episode in every environment, at the end of its history.

        Args:
            random: Generator of each environment: it decides all that is random in this
                episode and those that follow it.
            choices: Scene of each; None draws one.

        Raises:
            SceneChoiceError: if there is no such scene.
            TokensError: if a scene cannot be simulated.
        """
        self._random = list(random)
        count = len(self._random)
        scenes, seeds, routes = self._draw(range(count), choices, ago=0)
        starts = [s.episode(seed) for s, seed in zip(scenes, seeds, strict=True)]
        if self._world is None:
            self._world = World(self._simulator, starts, count + MAPS_KEPT)
        else:
            self._world.begin(starts)
        none = np.zeros(count)
        no = np.zeros(count, dtype=bool)
        self.ego = _logged_egos(scenes, ago=0)
        self.episodes = Episodes(
            tuple(scenes), tuple(routes), none, none, none, none, none, no, no
        )
        self._begin_counting(np.ones(count, dtype=bool))

    def step(
        self,
        actions: Float[np.ndarray, "environment value"],
        restarts: Bool[np.ndarray, " environment"],
    ) -> DrivingStep:
        """Drive all egos for one action; call ``settle`` before the next one.

        Args:
            actions: One for each environment, cut off at the bounds of their space.
            restarts: Environments whose action is ignored, because a new episode begins:
                after this step they are at its first one.

        Raises:
            ValueError: if an action is no number.
        """
        length_m = self.world.agents.size_lwh_m[:, EGO_ROW, 0]
        low, high = action_bounds(self.settings.action, self.settings.action_s)
        if not np.isfinite(actions).all():
            raise ValueError(f"action is {actions}; expected finite numbers")
        values = np.clip(actions.astype(np.float64), low, high)
        steps = self.settings.steps_per_action
        driven = drive(self.settings.action, values, self.ego, length_m, steps)
        before, collided, off_road = self.episodes, restarts & False, restarts & False
        if restarts.any():
            self._restart(restarts, steps_ahead=steps)
            before = self.episodes
        for state in driven:
            if restarts.any():
                scenes = self.episodes.scenes
                logged = _logged_egos(scenes, ago=self._steps_left() - 1)
                state = logged.where(restarts, state)
            self._advance(state)
            hits, leaves = self._crashes()
            collided |= hits & ~restarts
            off_road |= leaves & ~restarts
        if restarts.any():
            self._begin_counting(restarts)
        return self._what_happened(before, collided, off_road, ~restarts)

    def restart(self, which: Bool[np.ndarray, " environment"]) -> None:
        """Begin new episodes in some environments within the step that was just driven."""
        self._restart(which, steps_ahead=0)
        logged = _logged_egos(self.episodes.scenes, ago=self._steps_left())
        self.ego = logged.where(which, self.ego)
        self._begin_counting(which)

    def settle(self) -> None:
        """End the token step, if it is over."""
        self.world.settle()

    def observe(self) -> np.ndarray | Observation:
        """Return what each environment observes [environment, ...]."""
        episodes = self.episodes
        around = Surroundings(
            self.ego,
            self.world.agents,
            episodes.scenes,
            self.world.own_token,
            episodes.routes,
            episodes.along_m,
        )
        seen = observe(around, self.settings)
        if self.settings.observation == "dict":
            return seen
        flat = [values.reshape(len(values), -1) for values in seen.values()]
        return np.concatenate(flat, axis=1).astype(np.float32)

    def info(self) -> dict[str, np.ndarray]:
        """Return what is counted in each environment."""
        episodes, agents = self.episodes, self.world.agents
        return {
            "agents": agents.there.sum(axis=1),
            "inserted": self.world.inserted.copy(),
            "removed": self.world.removed.copy(),
            "collisions": episodes.collisions.astype(np.int64),
            "distance_m": episodes.distance_m.copy(),
            "route_m": episodes.along_m.copy(),
            "seconds": episodes.steps * CLOCK.step_s,
        }

    @property
    def world(self) -> World:
        """The traffic.

        Raises:
            ValueError: before the first reset.
        """
        if self._world is None:
            raise ValueError("no episode has begun; call reset() first")
        return self._world

    def _draw(
        self, environments: Sequence[int], choices: Sequence[SceneChoice], ago: int
    ) -> tuple[list[DrivingScene], list[int], list[Route]]:
        """Draw scene, seed and route of new episodes that begin some steps before now."""
        scenes, seeds, routes = [], [], []
        for at, choice in zip(environments, choices, strict=True):
            random = self._random[at]
            scene = self._chooser.choose(choice, random)
            scenes.append(scene)
            seeds.append(int(random.integers(MAX_SEED)))
            step = scene.scene.now - ago
            length_m = self.settings.route_length_m
            routes.append(make_route(scene.scene, random, length_m, step))
        return scenes, seeds, routes

    def _restart(self, which: np.ndarray, steps_ahead: int) -> None:
        """Put new episodes into the token step under way."""
        places = np.flatnonzero(which).tolist()
        ago = self._steps_left() - steps_ahead
        drawn, seeds, made = self._draw(places, [None] * len(places), ago)
        starts = [scene.episode(seed) for scene, seed in zip(drawn, seeds, strict=True)]
        self.world.replace(places, starts)
        scenes, routes = list(self.episodes.scenes), list(self.episodes.routes)
        for place, scene, route in zip(places, drawn, made, strict=True):
            scenes[place], routes[place] = scene, route
        self.episodes = replace(self.episodes, scenes=tuple(scenes), routes=tuple(routes))

    def _steps_left(self) -> int:
        """Steps until the token step under way ends."""
        return CLOCK.steps_per_token - self.world.phase

    def _advance(self, state: EgoState) -> None:
        moved = state.pose[:, :2] - self.ego.pose[:, :2]
        distance_m = self.episodes.distance_m + np.hypot(moved[:, 0], moved[:, 1])
        steps = self.episodes.steps + 1
        self.episodes = replace(self.episodes, distance_m=distance_m, steps=steps)
        self.ego = state
        self.world.step(state.pose)

    def _crashes(self) -> tuple[np.ndarray, np.ndarray]:
        """Tell which egos collide and which leave the road, and remember who did not."""
        episodes, agents = self.episodes, self.world.agents
        hits = nearest_agent_m(agents) < 0
        edges = [scene.edges for scene in episodes.scenes]
        leaves = off_road_m(agents, edges) > self.settings.off_road_m
        self.episodes = replace(
            episodes,
            was_clear=episodes.was_clear | ~hits,
            was_on_road=episodes.was_on_road | ~leaves,
        )
        return hits & episodes.was_clear, leaves & episodes.was_on_road

    def _begin_counting(self, which: np.ndarray) -> None:
        """Set the counts of some environments to those of a first step."""
        episodes = self.episodes
        found = [
            route.find(pose[:2])
            for route, pose in zip(episodes.routes, self.ego.pose, strict=True)
        ]
        along_m, off_m = np.array(found).T
        agents = self.world.agents
        edges = [scene.edges for scene in episodes.scenes]
        clear = nearest_agent_m(agents) >= 0
        on_road = off_road_m(agents, edges) <= self.settings.off_road_m
        self.episodes = replace(
            episodes,
            steps=np.where(which, 0, episodes.steps),
            along_m=np.where(which, along_m, episodes.along_m),
            off_route_m=np.where(which, off_m, episodes.off_route_m),
            distance_m=np.where(which, 0.0, episodes.distance_m),
            collisions=np.where(which, 0, episodes.collisions),
            was_clear=np.where(which, clear, episodes.was_clear),
            was_on_road=np.where(which, on_road, episodes.was_on_road),
        )

    def _what_happened(
        self,
        before: Episodes,
        collided: np.ndarray,
        off_road: np.ndarray,
        counted: np.ndarray,
    ) -> DrivingStep:
        """Compare the episodes with what they were one action earlier."""
        episodes = self.episodes
        found = [
            route.find(pose[:2], along_m)
            for route, pose, along_m in zip(
                episodes.routes, self.ego.pose, episodes.along_m, strict=True
            )
        ]
        along_m, off_m = np.array(found).T
        self.episodes = replace(
            episodes,
            along_m=along_m,
            off_route_m=off_m,
            collisions=episodes.collisions + collided,
        )
        length_m = np.array([route.length_m for route in episodes.routes])
        seconds = episodes.steps * CLOCK.step_s
        return DrivingStep(
            seconds=self.settings.action_s,
            progress_m=np.where(counted, along_m - before.along_m, 0.0),
            distance_m=np.where(counted, episodes.distance_m - before.distance_m, 0.0),
            route_offset_m=off_m,
            speed_mps=self.ego.speed_mps,
            accel_mps2=self.ego.accel_mps2,
            yaw_rate_rad_s=self.ego.yaw_rate_rad_s,
            collided=collided,
            off_road=off_road,
            route_ended=counted & (along_m >= length_m - END_M),
            timed_out=counted & (seconds >= self.settings.max_seconds - 1e-9),
        )


def _logged_egos(scenes: Sequence[DrivingScene], ago: int) -> EgoState:
    """Return the egos as they were logged some steps before the ends of the histories."""
    poses, speeds = [], []
    for one in scenes:
        scene = one.scene
        step = scene.now - ago
        poses.append(scene.tracks.pose(step)[scene.ego])
        speeds.append(np.hypot(*scene.tracks.velocity_mps[scene.ego, step]))
    return EgoState.at(
        np.array(poses, dtype=np.float64), np.array(speeds, dtype=np.float64)
    )
