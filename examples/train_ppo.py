"""Train a small PPO to drive, with stable-baselines3 on a batch of environments.

::

    pip install 'infgen[gym]' stable-baselines3
    python examples/train_ppo.py --steps 100000 --environments 16 --out policy.safetensors
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from safetensors.torch import save_file
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

from infgen.environment import ID


class BatchForPPO(VecEnv):
    """The batch of environments as stable-baselines3 wants it, actions from -1 to 1."""

    def __init__(self, num_envs: int, **settings: Any) -> None:
        self._envs = gymnasium.make_vec(
            ID,
            num_envs=num_envs,
            observation="flat",
            # As stable-baselines3 has it: an episode begins in the step that ends one.
            autoreset_mode=AutoresetMode.SAME_STEP,
            **settings,
        )
        actions = self._envs.single_action_space
        assert isinstance(actions, gymnasium.spaces.Box)
        self._middle = (actions.high + actions.low) / 2
        self._reach = (actions.high - actions.low) / 2
        unit = gymnasium.spaces.Box(-1.0, 1.0, actions.shape, np.float32)
        super().__init__(num_envs, self._envs.single_observation_space, unit)
        self._actions = np.zeros((num_envs, *unit.shape), dtype=np.float32)

    def reset(self) -> np.ndarray:
        """Begin all episodes."""
        seed = self._seeds[0]
        self._reset_seeds()
        return np.asarray(self._envs.reset(seed=seed)[0])

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions."""
        self._actions = self._middle + self._reach * actions

    def step_wait(self) -> Any:
        """Drive on."""
        seen, reward, terminated, truncated, told = self._envs.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for at in np.flatnonzero(terminated | truncated).tolist():
            infos[at]["terminal_observation"] = told["final_obs"][at]
            infos[at]["TimeLimit.truncated"] = bool(truncated[at])
            infos[at]["collisions"] = int(told["final_info"]["collisions"][at])
            infos[at]["distance_m"] = float(told["final_info"]["distance_m"][at])
        return np.asarray(seen), reward.astype(np.float32), terminated | truncated, infos

    def close(self) -> None:
        """End."""
        self._envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return what all environments have in common."""
        return [getattr(self._envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: nothing of a single environment can be set."""
        raise AttributeError(f"{attr_name} of a batch of environments cannot be set")

    def env_method(
        self, method_name: str, *arguments: Any, indices: Any = None, **more: Any
    ) -> list[Any]:
        """Refuse: a batch has no environments of its own."""
        raise AttributeError(f"environments of a batch have no method {method_name}")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return that none is."""
        return [False] * len(list(self._get_indices(indices)))


def train(steps: int, environments: int, seed: int, rollout_steps: int = 256) -> PPO:
    """Train a policy of two layers of 64."""
    batch = VecNormalize(VecMonitor(BatchForPPO(environments, max_seconds=30.0, hz=10)))
    model = PPO(
        "MlpPolicy",
        batch,
        n_steps=rollout_steps,
        batch_size=min(256, rollout_steps * environments),
        gamma=0.98,
        policy_kwargs={"net_arch": [64, 64], "log_std_init": -1.0},
        seed=seed,
        device="cpu",
        verbose=1,
    )
    return model.learn(total_timesteps=steps)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, and say how it went."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=100_000, help="of all environments")
    parser.add_argument("--environments", type=int, default=16, help="driven at once")
    parser.add_argument("--rollout-steps", type=int, default=256, help="between updates")
    parser.add_argument("--seed", type=int, default=0, help="of everything random")
    parser.add_argument("--out", type=Path, help="safetensors file for the policy")
    options = parser.parse_args(arguments)
    model = train(options.steps, options.environments, options.seed, options.rollout_steps)
    episodes = list(model.ep_info_buffer or ())
    if episodes:
        mean = np.mean([episode["r"] for episode in episodes])
        print(f"mean return of the last {len(episodes)} episodes: {mean:.2f}")
    if options.out:
        # Not `model.save`: what it writes holds pickles.
        save_file(model.policy.state_dict(), options.out)


if __name__ == "__main__":
    main()
