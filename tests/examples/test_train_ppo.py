"""The example trains a policy, and hands stable-baselines3 what it wants."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

pytest.importorskip("stable_baselines3", reason="needs stable-baselines3 (extra `dev`)")

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def ppo(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module("train_ppo")


def test_actions_from_minus_1_to_1_are_those_of_the_environment(ppo):
    batch = ppo.BatchForPPO(1)

    for unit, action in ((-1, [-8.0, -0.6]), (0, [-2.0, 0.0]), (1, [4.0, 0.6])):
        batch.step_async(np.full((1, 2), unit, dtype=np.float32))
        np.testing.assert_allclose(batch._actions[0], action, rtol=1e-6)
    assert batch.observation_space.contains(batch.reset()[0])


def test_the_last_observation_of_an_episode_is_told(ppo):
    batch = ppo.BatchForPPO(2, max_seconds=0.2)
    batch.seed(3)
    batch.reset()

    batch.step(np.zeros((2, 2)))
    _, _, ended, infos = batch.step(np.zeros((2, 2)))

    assert ended.all()
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert batch.observation_space.contains(infos[1]["terminal_observation"])


@pytest.mark.slow
def test_a_policy_is_trained_and_written(ppo, tmp_path, capsys):
    path = tmp_path / "policy.safetensors"
    words = "--steps 32 --environments 2 --rollout-steps 16"

    ppo.main([*words.split(), "--out", str(path)])

    assert "total_timesteps | 32" in capsys.readouterr().out
    weights = load_file(path)
    assert weights["log_std"].shape == (2,)
    assert all(np.isfinite(values).all() for values in weights.values())
