"""Many environments at once: each is as if it were alone, and begins anew by itself."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import infgen.environment as package
from infgen.environment.vector import DriveVectorEnv

LIVELY = {
    **{"insert": True, "remove": True, "max_agents": 24, "max_insertions": 2},
    **{"rules": "safe", "max_motion_samples": 3, "max_stall_s": 1.0},
}


def actions(step, count):
    """Something else for each environment, and at each step."""
    at = np.arange(count)
    return np.stack([0.5 + 0 * at, 0.03 * (-1.0) ** (step + at)], axis=1).astype(np.float32)


def assert_same(one, other, at=slice(None)):
    """Compare observations, up to rounding in the sums of the network."""
    for name in one:
        expected = other[name][at] if isinstance(other[name], np.ndarray) else other[name]
        if name not in ("map", "map_mask"):
            np.testing.assert_allclose(one[name], expected, atol=2e-3, err_msg=name)


def test_an_environment_of_a_batch_is_that_of_its_own_seed(crossing, drive_env, drive_envs):
    scenes = [crossing(speed_mps=speed) for speed in (10.0, 9.0)]
    many = drive_envs(2, *scenes, rollout=LIVELY)
    single = drive_env(*scenes, rollout=LIVELY)

    told = [many.reset(seed=4)]
    told += [many.step(actions(step, 2)) for step in range(11)]

    for at in range(2):
        observed, info = single.reset(seed=4 + at)
        assert_same({n: v[at] for n, v in told[0][0].items()}, observed)
        for step in range(11):
            observed, reward, terminated, truncated, info = single.step(
                actions(step, 2)[at]
            )
            seen, rewards, ends, cuts, infos = told[step + 1]
            assert_same({n: v[at] for n, v in seen.items()}, observed)
            assert rewards[at] == pytest.approx(reward, abs=1e-5)
            assert (ends[at], cuts[at]) == (terminated, truncated)
            assert {name: infos[name][at] for name in info} == pytest.approx(info)


@pytest.mark.parametrize("hz", [10, 2])
def test_after_its_end_an_environment_begins_anew_in_the_next_step(
    drive, drive_envs, coast, hz
):
    # 0.8 s: at 10 Hz the eighth step ends in the middle of a token step.
    ends = 8 if hz == 10 else 2
    env = drive_envs(2, drive(speed_mps=10.0), hz=hz, max_seconds=ends / hz)
    env.reset(seed=0)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP

    told = [env.step(coast(2)) for _ in range(ends + 2)]

    _, _, terminated, truncated, info = told[ends - 1]
    assert truncated.all()
    assert not terminated.any()
    assert info["distance_m"] == pytest.approx(10.0 * ends / hz, abs=1e-4)
    observed, reward, terminated, truncated, info = told[ends]
    assert reward.tolist() == [0.0, 0.0]
    assert not (terminated | truncated).any()
    assert info["seconds"].tolist() == [0.0, 0.0]
    # The ego of the log, not that which was driven.
    np.testing.assert_allclose(observed["ego"][:, 0], 10.0, atol=1e-4)
    np.testing.assert_allclose(told[-1][4]["seconds"], 1 / hz)
    np.testing.assert_allclose(told[-1][4]["distance_m"], 10.0 / hz, atol=1e-4)


def test_the_action_of_that_step_is_ignored(drive, drive_envs, coast):
    def first(accel_mps2):
        env = drive_envs(1, drive(speed_mps=10.0), max_seconds=0.3)
        env.reset(seed=0)
        for _ in range(3):
            env.step(coast(1))
        observed, *_ = env.step(np.float32([[accel_mps2, 0.0]]))
        return observed

    one, other = first(4.0), first(-8.0)

    assert_same(one, other)
    np.testing.assert_allclose(one["ego"][0, :2], [10.0, 0.0], atol=1e-4)


def test_an_episode_that_begins_within_a_token_step_follows_the_log_until_it_ends(
    crossing, drive_envs, coast
):
    """After three steps of 0.1 s the next one is the fourth of five: one is left."""
    env = drive_envs(1, crossing(), max_seconds=0.3)
    env.reset(seed=0)
    told = [env.step(coast(1))[0] for _ in range(5)]

    # The car of the log drives north, at (0, -50) when the ego is at (-30, 0) at now. One
    # step before, the ego of the log is at (-31, 0) and the car at (0, -51).
    np.testing.assert_allclose(told[3]["agents"][0, 0, :2], [31, -51], atol=1e-4)
    np.testing.assert_allclose(told[4]["agents"][0, 0, :2], [30, -50], atol=1e-4)


def test_in_the_same_step_the_last_observation_is_in_the_info(drive, drive_envs, coast):
    scene, mode = drive(speed_mps=10.0), AutoresetMode.SAME_STEP
    env = drive_envs(2, scene, max_seconds=0.4, autoreset_mode=mode)
    env.reset(seed=0)
    slower = np.float32([[0.0, 0.0], [-8.0, 0.0]])

    told = [env.step(slower) for _ in range(5)]

    observed, reward, _, truncated, info = told[3]
    assert truncated.all()
    assert "final_obs" not in told[2][4]
    # The last speed of the one that braked for 0.4 s, and the first of its next episode.
    assert info["final_obs"][1]["ego"][0] == pytest.approx(10.0 - 8.0 * 0.4, abs=1e-4)
    np.testing.assert_allclose(observed["ego"][:, 0], 10.0, atol=1e-4)
    assert info["final_info"]["seconds"].tolist() == pytest.approx([0.4, 0.4])
    assert info["seconds"].tolist() == [0.0, 0.0]
    assert reward[0] == pytest.approx(0.1, abs=1e-5)
    assert told[4][4]["seconds"].tolist() == pytest.approx([0.1, 0.1])


def test_an_episode_does_not_notice_when_others_end(crossing, drive_env, drive_envs):
    """The first environment crashes again and again beside the second one."""
    env = drive_envs(2, crossing(), rollout=LIVELY)
    alone = drive_env(crossing(), rollout=LIVELY)
    env.reset(seed=8)
    alone.reset(seed=9)
    ends = 0
    for step in range(18):
        action = actions(step, 2)
        action[0] = [0.0, -0.6]
        observed, _, terminated, _, _ = env.step(action)
        expected, *_ = alone.step(action[1])
        ends += terminated[0]
        assert_same({name: values[1] for name, values in observed.items()}, expected)
    assert ends >= 1


def test_the_whole_course_is_decided_by_the_seed(crossing, drive_envs):
    def course(seed):
        env = drive_envs(2, crossing(), crossing(speed_mps=6.0), rollout=LIVELY)
        told = [env.reset(seed=seed)[0]["agents"]]
        for step in range(8):
            hard = actions(step, 2)
            hard[0] = [0.0, -0.6]
            told.append(env.step(hard)[0]["agents"])
        return np.array(told)

    np.testing.assert_array_equal(course(1), course(1))
    assert not np.array_equal(course(1), course(2))


def test_a_crowded_scene_may_follow_an_empty_one(drive, parked, drive_envs, coast):
    env = drive_envs(2, drive(), parked(12), rollout={"max_agents": 4}, max_seconds=0.2)
    env.reset(seed=0, options={"scene": 0})

    most = max(env.step(coast(2))[4]["agents"].max() for _ in range(20))

    assert most == 13


def test_each_environment_may_have_a_scene_of_its_own(crossing, drive, drive_envs):
    env = drive_envs(2, crossing(), drive(speed_mps=3.0))

    observed, _ = env.reset(seed=0, options={"scene": [1, 0]})

    np.testing.assert_allclose(observed["ego"][:, 0], [3.0, 10.0], atol=1e-4)
    with pytest.raises(ValueError, match="3 scenes for 2 environments"):
        env.reset(options={"scene": [0, 0, 0]})
    with pytest.raises(ValueError, match="3 seeds for 2 environments"):
        env.reset(seed=[0, 1, 2])


def test_gymnasium_makes_it(crossing, simulator):
    env = gymnasium.make_vec(
        package.ID, num_envs=3, simulator=simulator(), scenes=[crossing()], hz=2
    )

    assert isinstance(env, DriveVectorEnv)
    observed, info = env.reset(seed=[3, 1, 2])
    assert env.observation_space.contains(observed)
    assert info["_agents"].all()
    *_, info = env.step(env.action_space.sample())
    assert info["seconds"].tolist() == [0.5, 0.5, 0.5]
    assert env.metadata["render_fps"] == 2
    env.close()


def test_what_cannot_be_is_refused(crossing, drive_envs):
    with pytest.raises(ValueError, match="choose NextStep or SameStep"):
        drive_envs(2, crossing(), autoreset_mode=AutoresetMode.DISABLED)
    with pytest.raises(ValueError, match="expected at least 1"):
        drive_envs(0, crossing())


def test_the_network_is_called_once_per_token_step_for_all(crossing, simulator, coast):
    playing, calls = simulator(), []
    ask = playing.stepper.motion_step

    def counted(*arguments):
        calls.append(arguments[1].presence.shape[0])
        return ask(*arguments)

    env = DriveVectorEnv(4, playing, [crossing()])
    env.reset(seed=0)
    playing.stepper.motion_step = counted
    for _ in range(15):
        env.step(coast(4))

    assert calls == [4, 4, 4]
