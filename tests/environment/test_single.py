"""One environment, as gymnasium wants it."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import infgen.environment as package
from infgen.environment.defaults import packaged_simulator
from infgen.environment.reward import default_reward
from infgen.environment.scenes import SceneChoiceError
from infgen.environment.single import DriveEnv
from infgen.errors import ConfigError

LIVELY = {"insert": True, "remove": True, "max_agents": 24, "max_insertions": 2}


@pytest.mark.parametrize("observation", ["dict", "flat"])
@pytest.mark.parametrize("action", ["bicycle", "waypoint"])
def test_the_checker_of_gymnasium_finds_nothing(crossing, simulator, observation, action):
    env = gymnasium.make(
        package.ID,
        simulator=simulator(**LIVELY),
        scenes=[crossing(), crossing(speed_mps=8.0)],
        observation=observation,
        action=action,
        disable_env_checker=True,
    )
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_env(env.unwrapped, skip_render_check=True)

    # Bounds of accelerations and angles are not -1 and 1, but what they mean.
    said = [str(one.message) for one in found]
    assert [words for words in said if "symmetric and normalized" not in words] == []


def played(env, seed, steps=7, **options):
    """All that an episode tells."""
    observed, info = env.reset(seed=seed, options=options)
    told = [(observed, 0.0, info)]
    for step in range(steps):
        action = np.float32([0.5, 0.02 * (-1) ** step])
        observed, reward, _, _, info = env.step(action)
        told.append((observed, reward, info))
    return told


def same(one, other):
    return all(
        np.array_equal(a["agents"], b["agents"]) and reward == again and info == later
        for (a, reward, info), (b, again, later) in zip(one, other, strict=True)
    )


def test_rules_are_those_of_the_simulator_unless_the_environment_names_others(
    crossing, simulator
):
    def course(rollout, **settings):
        playing = simulator(**LIVELY, add_bias=3.0, **rollout)
        env = DriveEnv(playing, [crossing()], hz=2, **settings)
        return played(env, 0, steps=3)

    safe, none = {"rules": "safe"}, {}

    assert same(course(safe), course(none, rules="safe"))
    assert same(course(none), course(safe, rules="none"))
    assert not same(course(safe), course(none))


def test_in_the_streets_of_the_package_others_have_rules():
    assert packaged_simulator().settings.rules_in_words == "safe"


def test_the_seed_decides_everything(crossing, drive_env):
    scenes = [crossing(speed_mps=speed) for speed in (10.0, 9.0, 8.0)]
    env, other = drive_env(*scenes, rollout=LIVELY), drive_env(*scenes, rollout=LIVELY)

    first = played(env, 5)

    assert same(first, played(env, 5))
    assert same(first, played(other, 5))
    assert not same(first, played(other, 6))


def test_without_a_seed_episodes_go_on_from_the_last_one(crossing, drive_env):
    env = drive_env(crossing(), rollout=LIVELY)
    one = [played(env, seed) for seed in (5, None)]
    two = [played(env, seed) for seed in (5, None)]

    assert not same(*one)
    assert same(one[1], two[1])


def test_a_scene_is_chosen_by_itself_its_id_or_its_number(crossing, drive, drive_env):
    env = drive_env(crossing(), drive(speed_mps=3.0))

    def speed(scene):
        observed, _ = env.reset(seed=0, options={"scene": scene})
        return observed["ego"][0]

    assert speed(0) == pytest.approx(10.0, abs=1e-4)
    assert speed(1) == pytest.approx(3.0, abs=1e-4)
    assert speed(-1) == speed(1)
    assert speed("made-by-hand") == speed(0)
    # A scene of one's own that has the id of another.
    assert speed(drive(speed_mps=7.0)) == pytest.approx(7.0, abs=1e-4)
    assert speed(0) == pytest.approx(10.0, abs=1e-4)


@pytest.mark.parametrize(
    ("choice", "said"), [(7, "has 1 scenes"), ("nowhere", "made-by-hand")]
)
def test_a_scene_that_is_not_there_is_named(crossing, drive_env, choice, said):
    with pytest.raises(SceneChoiceError, match=said):
        drive_env(crossing()).reset(options={"scene": choice})


def test_settings_that_cannot_be_are_named(crossing, drive_env):
    with pytest.raises(ConfigError, match="did you mean 'num_agents'"):
        drive_env(crossing(), num_agent=3)
    with pytest.raises(ConfigError, match=r"hz is 7; expected 10 or 2"):
        drive_env(crossing(), hz=7)
    with pytest.raises(SceneChoiceError, match="scenes is empty"):
        drive_env()


def test_actions_beyond_their_bounds_are_cut_off_and_others_refused(drive, drive_env):
    env = drive_env(drive(speed_mps=10.0))
    env.reset(seed=0)

    observed, *_ = env.step(np.float32([99.0, 0.0]))

    assert observed["ego"][1] == pytest.approx(4.0)  # m/s2
    with pytest.raises(ValueError, match="finite"):
        env.step(np.float32([np.nan, 0.0]))


@pytest.mark.parametrize(("hz", "steps"), [(10, 15), (2, 3)])
def test_an_episode_is_truncated_after_its_time(drive, drive_env, coast, hz, steps):
    env = drive_env(drive(speed_mps=1.0), hz=hz, max_seconds=1.5)
    env.reset(seed=0)

    told = [env.step(coast()) for _ in range(steps)]

    assert [one[3] for one in told] == [False] * (steps - 1) + [True]
    assert not any(one[2] for one in told)
    assert told[-1][4]["seconds"] == pytest.approx(1.5)


def test_an_episode_is_truncated_at_the_end_of_its_route(drive, drive_env, coast):
    # 20 m at 1 m a step, and no nearer to the end than 2 m.
    env = drive_env(drive(speed_mps=10.0), route_length_m=20.0)
    env.reset(seed=0)

    told = [env.step(coast()) for _ in range(18)]

    assert [one[3] for one in told] == [False] * 17 + [True]
    assert told[-1][4]["route_m"] == pytest.approx(18.0, abs=1e-4)


def test_progress_is_rewarded_and_a_reward_may_be_ones_own(drive, simulator, coast):
    told = []

    def own(step):
        told.append(step)
        return -np.abs(step.accel_mps2)

    for reward, expected in ((default_reward, 0.1 * 1.0), (own, -2.0)):
        env = DriveEnv(simulator(), [drive(speed_mps=10.0)], reward)
        env.reset(seed=0)
        action = coast() if reward is default_reward else np.float32([2.0, 0.0])
        assert env.step(action)[1] == pytest.approx(expected, abs=1e-5)
    assert told[0].progress_m[0] == pytest.approx(1.01, abs=1e-5)
    assert told[0].seconds == pytest.approx(0.1)


def test_others_react_one_token_step_later(parked, drive_env):
    """What the ego does in five steps changes nothing that others do in them."""

    def seen(ahead_m):
        env = drive_env(parked(4), action="waypoint")
        env.reset(seed=0)
        poses = []
        for _ in range(15):
            env.step(np.float32([ahead_m, 0.2, 0.0]))
            poses.append(env._batch.world.agents.pose[0, 1:5].copy())
        return np.array(poses)

    slow, fast = seen(0.0), seen(3.0)

    np.testing.assert_array_equal(slow[:5], fast[:5])
    assert not np.array_equal(slow[5:], fast[5:])


def test_agents_come_and_go_and_are_counted(crossing, drive_env, coast):
    env = drive_env(crossing(speed_mps=1.0), rollout=LIVELY)
    _, info = env.reset(seed=1)
    assert (info["agents"], info["inserted"], info["removed"]) == (3, 0, 0)

    for _ in range(20):
        *_, info = env.step(coast())

    assert info["inserted"] > 0
    # Who is removed is gone one token step later.
    assert 0 <= info["agents"] - (3 + info["inserted"] - info["removed"]) <= 24


def test_nothing_works_before_a_reset(crossing, drive_env, coast):
    with pytest.raises(ValueError, match="call reset"):
        drive_env(crossing()).step(coast())


def test_a_picture_is_painted(crossing, simulator):
    pytest.importorskip("aggdraw", reason="needs the extra `video`")
    env = DriveEnv(simulator(), [crossing()], render_mode="rgb_array")
    env.reset(seed=0)

    first = env.render()
    for _ in range(10):
        env.step(np.float32([4.0, 0.0]))

    assert first.shape == (480, 480, 3)
    assert first.dtype == np.uint8
    # The ego is in the middle and has its colour; the rest has moved.
    np.testing.assert_array_equal(first[240, 240], env.render()[240, 240])
    assert (first != env.render()).any()
    assert DriveEnv(simulator(), [crossing()]).render() is None
    with pytest.raises(ValueError, match="expected 'rgb_array'"):
        DriveEnv(simulator(), [crossing()], render_mode="human")


def test_registering_loads_neither_torch_nor_the_pipeline():
    code = (
        "import sys, infgen, infgen.environment, gymnasium; "
        "assert 'infgen/Drive-v0' in gymnasium.registry; "
        "sys.exit(bool({'torch', 'pipeline', 'infgen.rollout'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_package_itself_does_not_load_gymnasium():
    code = "import sys, infgen; sys.exit('gymnasium' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_id_may_name_its_module():
    spec = gymnasium.spec(package.ID)
    code = (
        "import gymnasium; "
        "gymnasium.envs.registration._find_spec('infgen.environment:infgen/Drive-v0')"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert spec.vector_entry_point.endswith("DriveVectorEnv")


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "infgen.environment")

    with pytest.raises(ImportError, match=r"pip install 'infgen\[gym\]'"):
        __import__("infgen.environment")
