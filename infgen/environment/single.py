"""The environment for one ego: a batch of one."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import UInt8

from infgen.environment.batch import DrivingBatch, Spaces
from infgen.environment.defaults import packaged_scenes, packaged_simulator
from infgen.environment.observation import Observation
from infgen.environment.render import RENDER_MODES, Renderer
from infgen.environment.reward import Reward, default_reward
from infgen.environment.settings import EnvironmentSettings
from infgen.rollout.simulator import Simulator
from infgen.scene import Scene
from infgen.settings import build

PLACE = "infgen/Drive-v0"
"""What messages about settings call the environment."""
SCENE = "scene"
"""The option of ``reset``."""


class DriveEnv(gymnasium.Env[np.ndarray | Observation, np.ndarray]):
    """Drive the ego through simulated traffic.

    ``docs/environment.md`` has the spaces. Keywords are ``EnvironmentSettings``.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        simulator: Simulator | None = None,
        scenes: Sequence[Scene] | None = None,
        reward: Reward = default_reward,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        """Prepare; nothing is simulated before ``reset``.

        Args:
            simulator: Network and settings; those of the package if None.
            scenes: Scenes that episodes begin in; those of the package if None.
            reward: What a step is worth.
            render_mode: ``"rgb_array"`` for pictures by ``render``, or None.
            **settings: Any of ``EnvironmentSettings``.

        Raises:
            ConfigError: for a setting that does not exist or cannot have its value.
        """
        chosen = build(EnvironmentSettings, settings, PLACE)
        self._batch = DrivingBatch(
            packaged_simulator() if simulator is None else simulator,
            packaged_scenes() if scenes is None else scenes,
            chosen,
        )
        self._reward, self.render_mode = reward, render_mode
        self._renderer = None if render_mode is None else Renderer(render_mode)
        self.metadata = self.metadata | {"render_fps": chosen.hz}
        each = Spaces.of(chosen)
        self.observation_space, self.action_space = each.observation, each.action

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray | Observation, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Decides all that is random from here on; None goes on with what there is.
            options: ``{"scene": ...}``: a ``Scene``, its id, or its number; any if left
                out.

        Raises:
            SceneChoiceError: if there is no such scene.
            TokensError: if the scene cannot be simulated.
        """
        super().reset(seed=seed)
        self._batch.reset([self.np_random], [(options or {}).get(SCENE)])
        return self._observe(), self._info()

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray | Observation, float, bool, bool, dict[str, Any]]:
        """Drive on for one action."""
        happened = self._batch.step(np.asarray(action)[None], np.zeros(1, dtype=bool))
        self._batch.settle()
        return (
            self._observe(),
            float(self._reward(happened)[0]),
            bool(happened.terminated[0]),
            bool(happened.truncated[0]),
            self._info(),
        )

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """Return a picture of the ego and what is around it, north up.

        Raises:
            MissingExtraError: without the extra ``video``.
        """
        if self._renderer is None:
            return None
        return self._renderer.paint(self._batch, 0)

    def _observe(self) -> np.ndarray | Observation:
        seen = self._batch.observe()
        if isinstance(seen, dict):
            return {name: values[0] for name, values in seen.items()}
        return seen[0]

    def _info(self) -> dict[str, Any]:
        return {name: values[0].item() for name, values in self._batch.info().items()}
