"""Egos driven from outside: they go where they are told, and the world reacts."""

import numpy as np
import pytest
import torch

from infgen.rollout.recording import collect
from infgen.rollout.rules.collision import find_collisions
from infgen.rollout.rules.off_road import RoadEdgeTiles, find_off_road
from infgen.rollout.session import Session
from infgen.rollout.simulate import simulate
from infgen.tokens.scene_tokens import Presence
from tests.rollout.single_rules import only

ALONE = {"insert": False, "remove": False, "max_agents": 6}


@pytest.fixture
def session(crossing, start, simulator):
    """``session(count=1, **settings)``: rollouts of a crossing, the ego at (-30, 0)."""

    def build(count=1, **settings):
        scene = crossing()
        starts = [start(scene, at) for at in range(count)]
        return Session(simulator(**{**ALONE, **settings}), starts)

    return build


def pose(x_m, y_m=0.0, heading_rad=0.0):
    return np.array([x_m, y_m, heading_rad], dtype=np.float32)


def test_without_a_driver_a_session_is_a_simulation(crossing, start, simulator):
    begin, playing = [start(crossing())], simulator(seconds=1.5, max_insertions=2)
    session = Session(playing, begin[0])

    frames = [session.step() for _ in range(3)]

    (stepped,) = collect(begin, frames, "weights")
    (simulated,) = collect(begin, list(simulate(playing, begin)), "weights")
    np.testing.assert_array_equal(stepped.xyz_m, simulated.xyz_m)
    assert session.token == 4


def test_the_ego_goes_where_it_is_driven(session):
    driven = session()
    np.testing.assert_allclose(driven.ego_pose, [[-30, 0, 0]], atol=1e-5)

    frame = driven.step(pose(-24.7, 0.3, 0.1))

    path = frame.path[0, 0]
    np.testing.assert_allclose(path[:, 0], [-28.94, -27.88, -26.82, -25.76, -24.7], 1e-5)
    np.testing.assert_allclose(path[:, 2], [0.02, 0.04, 0.06, 0.08, 0.1], atol=1e-6)
    np.testing.assert_array_equal(driven.ego_pose, [pose(-24.7, 0.3, 0.1)])


def test_five_poses_are_taken_as_they_are(session):
    driven = session()
    path = np.array([pose(-29 + step, step % 2) for step in range(5)])

    frame = driven.step(path)

    np.testing.assert_array_equal(frame.path[0, 0], path)


def test_a_way_that_turns_past_west_is_not_driven_backwards(session):
    driven = session()
    driven.step(pose(-25, 0, 3.1))

    frame = driven.step(pose(-27, 0, -3.1))

    assert (np.abs(frame.path[0, 0, :, 2]) > 3.09).all()


def test_errors_of_moves_do_not_add_up(session):
    # The vocabulary has whole metres only; 4.4 m per half second is none of its moves.
    driven = session()
    gaps_m, moves = [], []
    for step in range(1, 6):
        driven.step(pose(-30 + 4.4 * step))
        gaps_m.append(driven.ego_pose[0, 0] - driven.population.pose[0, 0, 0])
        moves.append(int(driven.population.motion_token[0, 0]))

    assert moves == [4, 5, 4, 5, 4]
    np.testing.assert_allclose(gaps_m, [0.4, -0.2, 0.2, -0.4, 0.0], atol=1e-4)


def test_others_react_in_the_next_half_second_and_not_before(session):
    def play(first):
        driven = session(motion_top_k=0)
        frames = [driven.step(first), driven.step(pose(-20))]
        return frames

    ahead, aside = play(pose(-25)), play(pose(-28, 6.0, 1.2))

    np.testing.assert_array_equal(ahead[0].path[0, 1:], aside[0].path[0, 1:])
    assert not np.array_equal(ahead[1].path[0, 1:], aside[1].path[0, 1:])


@pytest.mark.parametrize("plan", [pose(-28, 6.0, 1.2), None], ids=["elsewhere", "none"])
def test_an_ego_that_goes_elsewhere_than_planned_is_as_if_that_was_planned(session, plan):
    planned, driven = session(motion_top_k=0), session(motion_top_k=0)
    ways = [pose(-25), pose(-20)]
    expected = [planned.step(way) for way in ways]

    frames = [driven.end_step(driven.begin_step(plan), way) for way in ways]

    for frame, other in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame.path, other.path)
    np.testing.assert_array_equal(
        driven.population.motion_token, planned.population.motion_token
    )


def test_a_step_that_ends_as_it_began_is_a_step(session):
    whole, halves = session(motion_top_k=0), session(motion_top_k=0)
    for way in (None, pose(-25.4, 0.2), None):
        expected = whole.step(way)
        frame = halves.end_step(halves.begin_step(way))
        np.testing.assert_array_equal(frame.path, expected.path)
        np.testing.assert_array_equal(halves.ego_pose, whole.ego_pose)


def test_a_driven_ego_stands_exactly_where_it_was_driven(session):
    driven = session()

    driven.end_step(driven.begin_step(), pose(-25.4, 0.2, 0.03))

    np.testing.assert_array_equal(driven.ego_pose, [pose(-25.4, 0.2, 0.03)])
    assert driven.population.motion_token[0, 0] == 5  # From -30; moves are whole metres.


def test_the_network_takes_over_from_where_the_ego_really_is(session):
    driven = session()
    driven.step(pose(-25.4, 0.2))  # No move of the vocabulary ends there.

    frame = driven.step()

    moves_m = np.linalg.norm(np.diff(frame.path[0, 0, :, :2], axis=0), axis=1)
    first_m = np.linalg.norm(frame.path[0, 0, 0, :2] - [-25.4, 0.2])
    np.testing.assert_allclose(first_m, moves_m, atol=1e-4)


def test_each_rollout_of_a_batch_has_its_own_driver(session):
    driven = session(count=3)
    poses = np.array([pose(-25), pose(-26), pose(-27)])

    frame = driven.step(poses)

    np.testing.assert_array_equal(frame.path[:, 0, -1], poses)


@pytest.mark.parametrize(
    ("count", "shape"), [(1, (4, 3)), (2, (3,)), (2, (3, 3)), (2, (2, 4, 3))]
)
def test_other_numbers_of_poses_are_refused(session, count, shape):
    driven = session(count=count)

    with pytest.raises(ValueError, match=r"ego_pose has shape"):
        driven.step(np.zeros(shape, dtype=np.float32))


def test_newcomers_enter_around_the_driven_ego(crossing, start, simulator, force):
    playing = simulator(max_insertions=2, remove=False)
    force(playing, add=20.0)
    driven = Session(playing, start(crossing()))
    for step in range(1, 4):
        driven.step(pose(-30 + 8.0 * step))

    now = driven.population
    away_m = now.pose[0, :, :2] - driven.ego_pose[0, :2]
    entering = now.presence[0] == 2
    assert entering.any()
    assert (np.linalg.norm(away_m[entering], axis=1) < 75.6).all()


@pytest.mark.parametrize(("add", "leave"), [(0.0, -20.0), (-2.0, 1.0)])
def test_the_number_of_agents_is_held_to_what_it_was_at_now(
    parked, start, simulator, force, add, leave
):
    begin = [start(parked(6), at) for at in range(6)]
    counts = {}
    for firmly in (0.0, 40.0):
        playing = simulator(**only(density_control=firmly), max_agents=40)
        force(playing, add=add, leave=leave)
        session = Session(playing, begin)
        for _ in range(6):
            session.step()
        counts[firmly] = session.population.count_others(75.0)

    assert (np.abs(counts[0.0] - 6) > 1).any()
    assert (np.abs(counts[40.0] - 6) <= 1).all()


def new_hits(playing, begin, tokens=8):
    """How often somebody runs into another in a row of cars, all rollouts together."""
    session, count = Session(playing, begin), 0
    for _ in range(tokens):
        before = session.population
        way = session.step().path[:, :, [2, 4]]
        there = before.presence != Presence.ABSENT
        count += int(find_collisions(before, there, way).sum())
    return count


def test_who_would_run_into_somebody_draws_again(parked, start, simulator):
    """Moves of an untrained network are as good as drawn by lot; many cars are near."""
    begin = [start(parked(5), at) for at in range(12)]
    still = {"insert": False, "remove": False, "motion_top_k": 0}

    careless = new_hits(simulator(**still), begin)
    careful = new_hits(simulator(**still, **only(max_motion_samples=20)), begin)

    assert careless > 20
    assert careful < careless / 5


def test_where_nobody_would_run_into_anybody_nothing_changes(drive, start, simulator):
    begin = [start(drive(), at) for at in range(4)]
    alone = {"insert": False, "remove": False}

    careless, careful = (
        Session(simulator(**alone, **only(max_motion_samples=tries)), begin).step()
        for tries in (1, 20)
    )

    np.testing.assert_array_equal(careless.path, careful.path)


def off_the_road(playing, begin, tokens=8):
    """How often a vehicle leaves the road, all rollouts together."""
    road_edge_tiles, session, count = (
        [RoadEdgeTiles(begin[0].scene)],
        Session(playing, begin),
        0,
    )
    for _ in range(tokens):
        before = session.population
        way = session.step().path[:, :, [2, 4]]
        there = before.presence != Presence.ABSENT
        one_map = np.zeros(len(begin), dtype=np.int64)
        moments = np.full(there.shape, way.shape[2])
        found = find_off_road(before, there, way, moments, road_edge_tiles, one_map)
        count += int(found.sum())
    return count


def test_who_would_leave_the_road_draws_again_if_asked(drive, start, simulator):
    begin = [start(drive(), at) for at in range(24)]
    still = {"insert": False, "remove": False, "motion_top_k": 0}

    careless, careful = (
        off_the_road(
            simulator(**still, **only(max_motion_samples=20, reject_off_road=stays)), begin
        )
        for stays in (False, True)
    )

    assert careless > 20
    assert careful < careless / 5


@pytest.mark.slow
def test_who_has_to_steer_does_not_stop_for_it(drive, start, simulator):
    """Nobody else stands than would have anyway, though many draw again."""
    begin = [start(drive(), at) for at in range(200)]
    still = {"insert": False, "remove": False, "motion_top_k": 0}

    plain, kept = (
        Session(
            simulator(**still, **only(max_motion_samples=20, reject_off_road=stays)), begin
        )
        .step()
        .path
        for stays in (False, True)
    )

    stood, stands = ((path == path[:, :, :1]).all(axis=(1, 2, 3)) for path in (plain, kept))
    np.testing.assert_array_equal(stands, stood)
    assert 0 < stood.sum() < 20
    assert (plain != kept).any(axis=(1, 2, 3)).sum() > 30


@pytest.mark.slow
def test_who_can_stay_on_the_road_only_by_running_into_others_leaves_it(
    parked, start, simulator
):
    begin = [start(parked(5), at) for at in range(12)]
    still = {"insert": False, "remove": False, "motion_top_k": 0}

    careless = new_hits(simulator(**still), begin)
    careful = new_hits(
        simulator(**still, **only(max_motion_samples=40, reject_off_road=True)), begin
    )

    assert careful < careless / 5


def test_who_is_driven_is_never_drawn_for(parked, start, simulator):
    careful = only(max_motion_samples=5, reject_off_road=True)
    driven = Session(simulator(**careful, insert=False, remove=False), start(parked(1)))

    frame = driven.step(pose(8.0, -2.0))

    np.testing.assert_allclose(frame.path[0, 0, -1], [8.0, -2.0, 0.0], atol=1e-5)


def test_drawing_again_does_not_depend_on_other_rollouts(parked, start, simulator):
    playing = simulator(
        **only(max_motion_samples=5, reject_off_road=True, max_stall_s=1.0),
        **{"insert": False, "remove": False, "motion_top_k": 0},
    )
    begin = [start(parked(5), at) for at in range(4)]

    together = Session(playing, begin)
    alone = Session(playing, begin[2])
    for _ in range(4):
        many, one = together.step(), alone.step()

    np.testing.assert_allclose(many.path[2], one.path[0], atol=1e-4)


def test_who_is_too_fast_for_every_way_takes_the_slowest(drive, start, simulator):
    """The network knows 10 to 19 m to the right only, and all lead off the road soon."""
    begin = [start(drive(), at) for at in range(24)]
    still = {"insert": False, "remove": False, "motion_top_k": 0}

    def ways_m(playing):
        step, motion_token = playing.stepper.motion_step, torch.arange(61)
        fast = (motion_token > 40) & (motion_token % 20 >= 10)

        def heard(memory, token_step, rows):
            said = step(memory, token_step, rows)
            said.packed.motion_logits.masked_fill_(~fast, -torch.inf)
            return said

        playing.stepper.motion_step = heard
        session = Session(playing, begin)
        before = session.population.pose[:, 0, :2]
        return np.linalg.norm(session.step().path[:, 0, -1, :2] - before, axis=-1)

    careless, careful = (
        ways_m(simulator(**still, **only(max_motion_samples=40, reject_off_road=stays)))
        for stays in (False, True)
    )

    assert careless.mean() > 13
    assert np.median(careful) < 12
