"""A session of the facade: a planner drives, and what comes of it is recorded."""

import numpy as np
import pytest

import infgen


@pytest.fixture(scope="module")
def sim():
    return infgen.load("towns", seconds=1.0, count=2)


def test_a_session_that_nobody_drives_is_a_rollout(sim, scene):
    session = sim.session(scene, count=2, seed=4)
    for _ in range(2):
        session.step()

    driven, simulated = session.rollouts(), sim.rollout(scene, seed=4)
    for one, other in zip(driven, simulated, strict=True):
        np.testing.assert_array_equal(one.xyz_m, other.xyz_m, strict=True)
        np.testing.assert_array_equal(one.exit_step, other.exit_step, strict=True)
    assert driven.scene is scene


def test_the_ego_is_recorded_where_the_planner_drove_it(sim, scene):
    session = sim.session(scene)
    heading_rad = session.ego_pose[0, 2]
    ahead = np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0], dtype=np.float32)
    poses = [session.ego_pose[0] + 3 * (k + 1) * ahead for k in range(4)]

    for pose in poses:
        session.step(pose)

    (rollout,) = session.rollouts()
    np.testing.assert_allclose(
        rollout.xyz_m[rollout.ego, scene.now + 5 :: 5, :2],
        np.array(poses)[:, :2],
        atol=1e-4,
    )
    assert len(session.rollouts().to_polars().filter("is_ego")) == scene.now + 1 + 20


def test_a_step_in_two_halves_is_recorded_where_the_ego_went(sim, scene):
    session = sim.session(scene)
    plan, driven = session.ego_pose[0] + [[2, 0, 0], [3, 1, 0]]

    begun = session.begin_step(plan.astype(np.float32))
    session.end_step(begun, driven.astype(np.float32))

    (rollout,) = session.rollouts()
    end_m = rollout.xyz_m[rollout.ego, scene.now + 5, :2]
    np.testing.assert_allclose(end_m, driven[:2], atol=1e-4)


def test_before_the_first_step_there_is_nothing_to_show(sim, scene):
    with pytest.raises(ValueError, match=r"nothing has happened yet; call step\(\)"):
        sim.session(scene).rollouts()
