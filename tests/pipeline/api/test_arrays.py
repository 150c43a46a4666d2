"""Anyone's arrays: the same numbers as from the parts they are made of, or a clear no."""

import inspect
from dataclasses import replace

import numpy as np
import pytest

import infgen
from infgen.metrics.wosac import metric as wosac
from pipeline.api.arrays import ArraysError
from tests.exports.replays import replay

STEPS = 80
KEPT = ("id", "agent_type", "size_lwh_m", "xyz_m", "heading_rad", "valid", "logged")


@pytest.fixture(scope="module")
def standing(scene):
    """Everyone stands where they are now: [4 rollouts, agent, step, 4]."""
    rows = scene.tracks.valid[:, scene.now]
    pose = np.column_stack(
        [scene.tracks.xyz_m[rows, scene.now], scene.tracks.heading_rad[rows, scene.now]]
    )
    return np.broadcast_to(pose[None, :, None], (4, len(pose), STEPS, 4)).copy()


def official(scene) -> dict[str, float]:
    """Scores of the same, from the metric's own records."""
    log = wosac.from_scene(scene)
    rows, still = log.sim_rows, np.ones((4, len(log.sim_rows), STEPS), dtype=np.float32)
    rollouts = wosac.Rollouts(
        scenario_id=log.scenario_id,
        object_id=log.id[rows].astype(np.int64),
        x_m=still * log.x_m[rows, 10, None],
        y_m=still * log.y_m[rows, 10, None],
        z_m=still * log.z_m[rows, 10, None],
        heading_rad=still * log.heading_rad[rows, 10, None],
    )
    return wosac.score(log, rollouts).numbers()


def test_arrays_are_scored_as_the_metrics_own_records(scene, standing):
    expected = official(scene)
    world = standing + np.array([*scene.origin_xyz_m, 0.0])

    assert dict(infgen.score(standing, scene)) == expected
    assert dict(infgen.score(standing[..., [0, 1, 3]], scene)) == expected
    assert dict(infgen.score(world, scene, frame="world")) == expected
    assert dict(infgen.score(world[..., [0, 1, 3]], scene, frame="world")) == expected


def test_agents_may_come_in_any_order(scene, standing):
    ids = scene.tracks.id[scene.tracks.valid[:, scene.now]]
    order = np.random.default_rng(0).permutation(len(ids))

    found = infgen.score(standing[:, order], scene, object_id=ids[order].tolist())

    assert dict(found) == pytest.approx(official(scene), abs=1e-7)


def test_rollouts_that_become_arrays_come_back(scene):
    rollout = replay(scene, shift_m=1.0)
    poses = np.concatenate([rollout.xyz_m, rollout.heading_rad[..., None]], axis=-1)

    (again,) = infgen.rollouts_from_arrays(
        poses[None, :, scene.now + 1 :], scene, object_id=rollout.id
    )

    for name in (
        "id",
        "agent_type",
        "size_lwh_m",
        "xyz_m",
        "heading_rad",
        "valid",
        "logged",
    ):
        np.testing.assert_array_equal(
            getattr(again, name), getattr(rollout, name), strict=True
        )
    assert (again.ego, again.now) == (rollout.ego, rollout.now)
    assert (again.exit_step == -1).all()


def test_agents_enter_and_leave_where_they_are_valid(scene, standing):
    tracks = scene.tracks
    ids = tracks.id[tracks.valid[:, scene.now]]
    ego = int(np.flatnonzero(ids == tracks.id[scene.ego])[0])
    other = 0 if ego else 1
    poses = np.concatenate([standing, standing[:, [ego]] + [9.0, 0, 0, 0]], axis=1)
    valid = np.ones(poses.shape[:3], dtype=bool)
    valid[:, other, 30:] = False
    valid[:, -1, :6] = False
    valid[1, -1] = False  # Nobody is inserted in this one.
    new = int(tracks.id.max()) + 1
    found = infgen.rollouts_from_arrays(
        poses,
        scene,
        object_id=np.append(ids, new),
        valid=valid,
        agent_type=np.zeros(len(ids) + 1, dtype=np.int8),
        size_lwh_m=np.tile([4.0, 2.0, 1.5], (len(ids) + 1, 1)),
    )

    first, second = found[0], found[1]
    assert first.id[-1] == new
    assert not first.logged[-1]
    assert first.logged[:-1].all()
    assert new not in second.id
    assert first.entry_step[-1] == scene.now + 6
    assert first.exit_step[other] == scene.now + 30
    reference = infgen.open_reference([scene])
    scores = found[:1].score("corrected", reference=reference)
    assert scores["rate/entries"] == pytest.approx(1 / 8)
    assert scores["rate/exits"] == pytest.approx(1 / 8)


def wrong(scene, standing, case):
    ids = scene.tracks.id[scene.tracks.valid[:, scene.now]]
    ego = scene.tracks.id[scene.ego]
    hole = standing.copy()
    hole[2, 1, 7, 0] = np.nan
    return {
        "shape": ((standing[..., :2],), {}, "expected floats .*3 or 4"),
        "agents": ((standing[:, 1:],), {}, f"expected floats .rollout, {len(ids)} agents"),
        "whole numbers": ((standing.astype(int),), {}, "int64 .*expected floats"),
        "nan": ((hole,), {}, f"rollout 2, agent {ids[1]}, step 7 after now .*not finite"),
        "frame": ((standing,), {"frame": "map"}, "'map'; expected 'scene' or 'world'"),
        "far": ((standing + 3000.0,), {}, "begin 4243 m .*need frame='world'"),
        "ego": (
            (standing[:, ids != ego],),
            {"object_id": ids[ids != ego]},
            f"lacks the ego, agent {ego}",
        ),
        "twice": ((standing,), {"object_id": np.full(len(ids), ego)}, "each id once"),
        "foreign": (
            (standing,),
            {"object_id": np.where(ids == ego, ego, ids + 900)},
            "is not in the log; agent_type must be given",
        ),
        "valid": ((standing,), {"valid": np.ones((4, 2, STEPS))}, "valid is float64"),
    }[case]


CASES = (
    "shape",
    "agents",
    "whole numbers",
    "nan",
    "frame",
    "far",
    "ego",
    "twice",
    "foreign",
    "valid",
)


@pytest.mark.parametrize("case", CASES)
def test_arrays_that_do_not_fit_are_refused(scene, standing, case):
    arrays, more, message = wrong(scene, standing, case)

    # Users do not have the checks of annotations that tests have.
    plain = inspect.unwrap(infgen.rollouts_from_arrays)

    with pytest.raises(ArraysError, match=message):
        plain(*arrays, scene, **more)


def test_a_scene_far_from_its_origin_loses_no_bit(scene):
    """World coordinates in float32, as in records, come through the local frame whole."""
    moved = replace(scene, origin_xyz_m=np.array([-8123.0, 5321.0, -12.0]))
    log = wosac.from_scene(moved)
    rows, still = log.sim_rows, np.ones((2, len(log.sim_rows), STEPS), dtype=np.float32)
    states = (log.x_m, log.y_m, log.z_m, log.heading_rad)
    world = np.stack([still * state[rows, 10, None] for state in states], axis=-1)

    found = infgen.rollouts_from_arrays(world, moved, frame="world")

    given = wosac.from_rollouts(tuple(found))
    np.testing.assert_array_equal(given.x_m, world[..., 0], strict=True)
    np.testing.assert_array_equal(given.y_m, world[..., 1], strict=True)
