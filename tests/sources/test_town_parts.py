import dataclasses

import numpy as np
import pytest

from infgen.geometry import to_world
from infgen.scene import AgentKind, SignalState
from infgen.sources.towns import curves
from infgen.sources.towns.build import draw_town
from infgen.sources.towns.demand import draw_users
from infgen.sources.towns.roads import Place
from infgen.sources.towns.routes import find_routes
from infgen.sources.towns.sight import Actors, _closed, _opened, seen
from infgen.sources.towns.town import SignalPlan
from infgen.sources.towns.traffic import simulate


@pytest.fixture(scope="module")
def played():
    """A crossing with signals, its routes, users, and 20 s of traffic."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        town = draw_town(rng)
        if town.plan is not None:
            routes = find_routes(town)
            users = draw_users(town, routes, 20.0, rng)
            return town, routes, users, simulate(town, routes, users, 200, rng)
    raise AssertionError("no crossing with signals in twenty towns")


# Parts


def test_groups_of_signals_never_go_together():
    plan = SignalPlan((12.0, 8.0), 3.0, 1.5, 5.0, 4.0)
    for time_s in np.arange(0, 60, 0.1).tolist():
        states = {plan.state(group, time_s) for group in (0, 1)}
        assert SignalState.STOP in states
        for group in (0, 1):
            assert (
                not plan.walk(group, time_s) or plan.state(group, time_s) == SignalState.GO
            )


def test_a_light_goes_warns_and_stops_for_as_long_as_its_plan_says():
    plan = SignalPlan((12.0, 8.0), 3.0, 1.5, 5.0, 0.0)
    shown = [plan.state(0, time_s) for time_s in (0.0, 11.9, 12.1, 14.9, 15.1, 28.9, 29.1)]
    go, warn, stop = SignalState.GO, SignalState.CAUTION, SignalState.STOP
    assert shown == [go, go, warn, warn, stop, stop, go]


@pytest.mark.parametrize("turn_rad", [0.0, np.pi / 2, -np.pi / 3])
def test_joins_leave_and_arrive_in_the_given_directions(turn_rad):
    start = np.array([1.0, 2.0, 0.3])
    end = np.array([11.0, 2.0 + 10 * np.sign(turn_rad), 0.3 + turn_rad])

    xy_m = curves.join(start, end, 0.5)

    np.testing.assert_allclose(xy_m[[0, -1]], [start[:2], end[:2]], atol=1e-9)
    np.testing.assert_allclose(curves.start_pose(xy_m)[2], start[2], atol=0.1)
    np.testing.assert_allclose(curves.end_pose(xy_m)[2], end[2], atol=0.1)


def test_a_quarter_turn_is_joined_by_nearly_an_arc():
    xy_m = curves.join(np.array([10.0, 0.0, np.pi / 2]), np.array([0.0, 10.0, np.pi]), 0.25)

    np.testing.assert_allclose(np.linalg.norm(xy_m, axis=1), 10.0, atol=0.01)
    assert curves.length(xy_m) == pytest.approx(5 * np.pi, rel=1e-3)


def test_a_parallel_lies_to_the_left():
    line_m = np.column_stack([np.arange(5.0), np.zeros(5)])

    np.testing.assert_allclose(curves.offset(line_m, 2.0), line_m + np.array([0.0, 2.0]))


def test_rounded_corners_keep_the_ends():
    corner_m = np.array([[0, 0], [1, 0], [2, 0], [3, 0], [3, 1], [3, 2], [3, 3]], float)

    round_m = curves.smooth(corner_m, 1.0, 1.0)

    np.testing.assert_allclose(round_m[[0, -1]], corner_m[[0, -1]])
    np.testing.assert_allclose(round_m[3], [8 / 3, 1 / 3])


def test_curved_stretches_are_slowed_down_for_in_time(played):
    _, routes, _, _ = played
    for route in range(len(routes.strips)):
        rows = slice(
            routes.first[route], routes.first[route] + int(routes.length_m[route] * 2)
        )
        squared = routes.limit_mps[rows] ** 2
        # Half a metre of gentle braking takes so much off the square of the speed.
        assert (np.diff(squared) >= -2 * 1.1 * 0.5 - 1e-9).all()


def test_claims_keep_users_of_crossing_strips_apart(played):
    town, routes, users, traffic = played
    gated = np.array([strip.gate is not None for strip in town.strips])
    half_m = users.size_lwh_m[:, 0] / 2
    for step in range(200):
        here = np.flatnonzero(traffic.present[:, step])
        route, along_m = traffic.route[here, step], traffic.along_m[here, step]
        used = np.zeros(len(town.strips), bool)
        # Half a metre is what positions on a route are sampled by.
        rear_m, front_m = along_m - half_m[here] + 0.5, along_m + half_m[here]
        for at_m in (rear_m, along_m, front_m):
            used[routes.strip[routes.row(route, at_m)]] = True
        used &= gated
        assert not (town.conflicts & used[:, None] & used[None]).any()


def test_nobody_drives_through_whoever_is_ahead(played):
    _, _, users, traffic = played
    for route in np.unique(traffic.route):
        for step in range(0, 200, 10):
            rows = np.flatnonzero(
                traffic.present[:, step] & (traffic.route[:, step] == route)
            )
            rows = rows[np.argsort(traffic.along_m[rows, step])]
            gap_m = np.diff(traffic.along_m[rows, step])
            lengths_m = users.size_lwh_m[rows, 0]
            assert (gap_m > (lengths_m[1:] + lengths_m[:-1]) / 2).all()


def test_conflicts_are_mutual_and_never_within_a_queue(played):
    town, *_ = played
    assert (town.conflicts == town.conflicts.T).all()
    assert town.conflicts.any()
    for strip in town.strips:
        for one in strip.exits:
            assert not any(town.conflicts[one, other] for other in strip.exits)


# Sight


def _actors(*tracks, sizes=None):
    """Actors that stand still at the given poses for 12 steps."""
    pose = np.repeat(np.array(tracks, float)[:, None], 12, axis=1)
    count = len(tracks)
    return Actors(
        kind=np.zeros(count, np.int64),
        size_lwh_m=np.array(sizes or [(4.0, 2.0, 1.5)] * count),
        pose=pose,
        present=np.ones((count, 12), bool),
    )


NO_WALLS = np.zeros((0, 5))


def _see(actors, walls=NO_WALLS):
    return seen(actors, 0, walls, np.random.default_rng(0))


def test_what_is_near_is_seen_and_what_is_far_is_not():
    shown = _see(_actors((0, 0, 0), (30, 0, 0), (130, 0, 0)))

    assert shown.all(axis=1).tolist() == [True, True, False]
    assert not shown[2].any()


def test_a_wall_hides_what_is_behind_it_only():
    wall = np.array([[20.0, 0.0, 0.4, 8.0, 6.0]])

    shown = _see(_actors((0, 0, 0), (35, 0, 0), (35, 30, 0), (10, 0, 0)), wall)

    assert shown[:, 0].tolist() == [True, False, True, True]


def test_a_truck_hides_a_car_but_a_car_does_not():
    places = (0, 0, 0), (20, 0, 0), (32, 0, 0)
    low, tall = (4.0, 2.0, 1.5), (8.0, 2.5, 3.2)

    assert _see(_actors(*places)).all()
    assert _see(_actors(*places, sizes=[low, tall, low]))[:, 0].tolist() == [
        True,
        True,
        False,
    ]


def test_the_ego_always_sees_itself():
    assert _see(_actors((0, 0, 0)), np.array([[0.0, 0.0, 0.0, 9.0, 9.0]]))[0].all()


def test_short_gaps_are_bridged_and_short_sights_dropped():
    shown = np.array([[1, 1, 1, 0, 0, 1, 1, 1, 0, 0, 0, 1, 0, 0, 0]], bool)

    bridged = _closed(shown, 3)

    assert bridged[0].astype(int).tolist() == [1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 1, 0, 0, 0]
    assert _opened(bridged, 3)[0].astype(int).tolist() == [1] * 8 + [0] * 7


def test_positions_on_a_route_are_points_of_its_strips(played):
    town, routes, _, _ = played
    route = int(np.flatnonzero(routes.kind == AgentKind.VEHICLE)[0])
    first = town.strips[routes.strips[route][0]].xy_m

    at = routes.points(np.array([route, route]), np.array([0.0, 10.0]))

    np.testing.assert_allclose(at[0], first[0], atol=1e-6)
    np.testing.assert_allclose(
        at[1], curves.points_at(first, np.array([10.0]))[0], atol=0.02
    )


def test_placing_a_town_keeps_distances(played):
    place = Place(0.7, np.array([100.0, -50.0]), np.array([0.01, 0.0]), 5.0)
    ends_m = np.array([[0.0, 0.0], [3.0, 4.0]])

    world_m = place.xy_m(ends_m)

    assert np.linalg.norm(world_m[1] - world_m[0]) == pytest.approx(5.0)
    np.testing.assert_allclose(world_m[0], [100.0, -50.0])
    np.testing.assert_allclose(
        world_m[1],
        to_world(np.array([[3.0, 4.0, 0.0]]), np.array([[100.0, -50.0, 0.7]]))[0, :2],
    )
    assert place.ground_m(world_m)[0] == 5.0


def test_a_town_is_not_edited_while_it_is_used(played):
    town, routes, users, _ = played
    before = dataclasses.replace(users)

    simulate(town, routes, users, 20, np.random.default_rng(1))

    for field in dataclasses.fields(before):
        np.testing.assert_array_equal(
            getattr(before, field.name), getattr(users, field.name)
        )
