"""The environment for many egos: one call of the network per token step for all of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float64, UInt8

from infgen.environment.batch import DrivingBatch, Spaces
from infgen.environment.defaults import packaged_scenes, packaged_simulator
from infgen.environment.observation import Observation
from infgen.environment.render import RENDER_MODES, Renderer
from infgen.environment.reward import Reward, default_reward
from infgen.environment.scenes import SceneChoice
from infgen.environment.settings import EnvironmentSettings
from infgen.environment.single import PLACE, SCENE
from infgen.rollout.simulator import Simulator
from infgen.scene import Scene
from infgen.settings import build

Flags = Bool[np.ndarray, " environment"]
Seen = np.ndarray | Observation


class DriveVectorEnv(VectorEnv[Seen, np.ndarray, np.ndarray]):
    """Drive many egos, each through traffic of its own.

    An environment whose episode has ended begins another one by itself, in a scene that is
    drawn: in the next step (``AutoresetMode.NEXT_STEP``), whose action it ignores, or in
    the same one (``SAME_STEP``), with ``final_obs`` and ``final_info`` in the info. It may
    be in the middle of a token step: up to 0.4 s before the end of its history.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": list(RENDER_MODES),
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        simulator: Simulator | None = None,
        scenes: Sequence[Scene] | None = None,
        reward: Reward = default_reward,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        **settings: Any,
    ) -> None:
        """Prepare; nothing is simulated before ``reset``.

        Args:
            num_envs: Number of environments.
            simulator: Network and settings; those of the package if None.
            scenes: Scenes that episodes begin in; those of the package if None.
            reward: What a step is worth.
            render_mode: ``"rgb_array"`` for pictures by ``render``, or None.
            autoreset_mode: When an environment begins its next episode.
            **settings: Any of ``EnvironmentSettings``.

        Raises:
            ConfigError: for a setting that does not exist or cannot have its value.
            ValueError: for a number of environments or an autoreset mode that cannot be.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; expected at least 1")
        self._mode = AutoresetMode(autoreset_mode)
        if self._mode is AutoresetMode.DISABLED:
            raise ValueError(
                "autoreset_mode is Disabled, but environments of a batch go on together; "
                "choose NextStep or SameStep"
            )
        chosen = build(EnvironmentSettings, settings, PLACE)
        self._batch = DrivingBatch(
            packaged_simulator() if simulator is None else simulator,
            packaged_scenes() if scenes is None else scenes,
            chosen,
        )
        self._reward, self.render_mode, self.num_envs = reward, render_mode, num_envs
        self._renderer = None if render_mode is None else Renderer(render_mode)
        own = {"render_fps": chosen.hz, "autoreset_mode": self._mode}
        self.metadata = self.metadata | own
        each = Spaces.of(chosen)
        self.single_observation_space = each.observation
        self.single_action_space = each.action
        self.observation_space = batch_space(each.observation, num_envs)
        self.action_space = batch_space(each.action, num_envs)
        self._random: list[np.random.Generator] = []
        self._ended = np.zeros(num_envs, dtype=bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Seen, dict[str, Any]]:
        """Begin an episode in every environment.

        Args:
            seed: Environment ``i`` is seeded with ``seed + i``, or with the i-th of
                several; None goes on with what there is.
            options: ``{"scene": ...}``: a ``Scene``, its id, or its number, or a list of
                one of these (or None) for each environment; any if left out.

        Raises:
            SceneChoiceError: if there is no such scene.
            TokensError: if a scene cannot be simulated.
            ValueError: if there are not as many seeds or scenes as environments.
        """
        self._seed(seed)
        self._batch.reset(self._random, self._choices((options or {}).get(SCENE)))
        self._ended[:] = False
        return self._batch.observe(), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[Seen, Float64[np.ndarray, " environment"], Flags, Flags, dict[str, Any]]:
        """Drive all egos on for one action."""
        batch, restarts = self._batch, self._ended
        happened = batch.step(np.asarray(actions), restarts)
        reward = np.where(restarts, 0.0, self._reward(happened))
        terminated = happened.terminated & ~restarts
        truncated = happened.truncated & ~restarts
        ended, final = terminated | truncated, {}
        if self._mode is AutoresetMode.SAME_STEP:
            final = self._final(ended)
            if ended.any():
                batch.restart(ended)
        else:
            self._ended = ended
        batch.settle()
        return batch.observe(), reward, terminated, truncated, self._info() | final

    def render(self) -> tuple[UInt8[np.ndarray, "height width 3"], ...] | None:
        """Return a picture of each environment, north up.

        Raises:
            MissingExtraError: without the extra ``video``.
        """
        if self._renderer is None:
            return None
        return tuple(self._renderer.paint(self._batch, at) for at in range(self.num_envs))

    def _seed(self, seed: int | Sequence[int | None] | None) -> None:
        """Seed the generators of environments as gymnasium's own vector ones do."""
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))
            seeds: Sequence[int | None] = [int(seed) + at for at in range(self.num_envs)]
        else:
            seeds = [None] * self.num_envs if seed is None else seed
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"{len(seeds)} seeds for {self.num_envs} environments; give one or all"
            )
        goes_on = bool(self._random)
        self._random = [
            self._random[at] if own is None and goes_on else seeding.np_random(own)[0]
            for at, own in enumerate(seeds)
        ]

    def _choices(self, scene: SceneChoice | Sequence[SceneChoice]) -> list[SceneChoice]:
        if scene is None or isinstance(scene, Scene | str | int):
            return [scene] * self.num_envs
        if len(scene) != self.num_envs:
            raise ValueError(
                f"{len(scene)} scenes for {self.num_envs} environments; give one, or one "
                "each"
            )
        return list(scene)

    def _info(self) -> dict[str, Any]:
        """Info by name, with the mask of each that gymnasium has: all have all of them."""
        info = self._batch.info()
        everyone = np.ones(self.num_envs, dtype=bool)
        return {**info, **{f"_{name}": everyone.copy() for name in info}}

    def _final(self, ended: Flags) -> dict[str, Any]:
        """Last observations and infos of ended episodes, as gymnasium has them."""
        if not ended.any():
            return {}
        seen, last = self._batch.observe(), np.full(self.num_envs, None, dtype=object)
        for at in np.flatnonzero(ended).tolist():
            last[at] = (
                {name: values[at] for name, values in seen.items()}
                if isinstance(seen, dict)
                else seen[at]
            )
        info: dict[str, Any] = {}
        for name, values in self._batch.info().items():
            info[name] = np.where(ended, values, 0)
            info[f"_{name}"] = ended.copy()
        return {
            "final_obs": last,
            "_final_obs": ended.copy(),
            "final_info": info,
            "_final_info": ended.copy(),
        }
