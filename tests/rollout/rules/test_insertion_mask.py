"""The insertion mask around an ego at the origin of a straight road, cars beside it."""

import numpy as np
import pytest

from infgen.geometry import boxes_overlap
from infgen.rollout.population import InsertedAgents, place_logged_agents
from infgen.rollout.rules.insertion_mask import make_insertion_mask
from infgen.scene import AgentType
from infgen.tokens.map import PolylineType
from infgen.tokens.scene_tokens import FIRST_MOTION_TOKEN

CAR, WALKER = AgentType.VEHICLE, AgentType.PEDESTRIAN
SIZE = {CAR: (4.0, 2.0, 1.5), WALKER: (1.0, 1.0, 1.7)}


@pytest.fixture
def begun(parked, start):
    """The ego at the origin facing +x, another car at (8, -2); the lane is y = 0."""
    begin = start(parked(1))
    return begin, place_logged_agents([begin], min_rows=4)[-1]


def inserted(x_m, y_m, agent_type=CAR, turned_rad=0.0):
    # The grid's +y is the ego's +x, its +x the ego's right.
    return InsertedAgents(
        who=np.array([True]),
        position_m=np.array([[-y_m, x_m]], dtype=np.float32),
        turned_rad=np.array([turned_rad], dtype=np.float32),
        agent_type=np.array([agent_type], dtype=np.int8),
        size_lwh_m=np.array([SIZE[agent_type]], dtype=np.float32),
    )


@pytest.fixture
def books(metre_moves, bent_roads):
    return metre_moves, bent_roads


def room_of(begin, books, lane_m):
    return make_insertion_mask([begin.history], books, np.zeros(1, dtype=np.int64), lane_m)


@pytest.mark.parametrize(
    ("newcomer_at", "allowed"),
    [
        ((30, 0), True),
        ((30, 4.9), True),
        ((30, 5.1), False),  # Too far from the lane ...
        ((30, 5.1, WALKER), True),  # ... for a vehicle.
        ((12.5, -2), True),  # Boxes are 4.8 and 4 long: 4.4 m keep them apart.
        ((12.3, -2), False),
        ((8, 0.5, CAR, np.pi / 2), False),  # Across the road.
        ((8, 1.1, CAR, np.pi / 2), True),
        ((8, -2, WALKER), False),  # Inside a car.
        ((2.0, 0), False),  # On the ego.
    ],
)
def test_newcomers_stand_on_nobody_and_vehicles_by_a_lane(
    begun, books, newcomer_at, allowed
):
    begin, population = begun
    insertion_mask = room_of(begin, books, lane_m=5.0)

    assert insertion_mask.allows(population, inserted(*newcomer_at)).tolist() == [allowed]


def test_pedestrians_may_walk_close_together(begun, books):
    begin, population = begun
    insertion_mask = room_of(begin, books, lane_m=5.0)
    population.agent_type[0, 1] = WALKER
    population.size_lwh_m[0, 1] = SIZE[WALKER]

    assert insertion_mask.allows(population, inserted(8.3, -2, WALKER)).all()
    assert not insertion_mask.allows(population, inserted(8.3, -2, CAR)).any()


def test_nobody_enters_where_another_will_be_in_half_a_second(begun, books):
    """The car at (8, -2), 4.8 m long, drives on by 5 m: inserted agents are 4 m long."""
    begin, population = begun
    insertion_mask = room_of(begin, books, lane_m=1e6)
    ahead = [inserted(x_m, -2) for x_m in (12.5, 17.3, 17.5)]

    population.motion_token[0, 1] = 0
    stands = [insertion_mask.allows(population, one).item() for one in ahead]
    population.motion_token[0, 1] = 5
    drives = [insertion_mask.allows(population, one).item() for one in ahead]
    population.motion_token[0, 1] = FIRST_MOTION_TOKEN
    enters = [insertion_mask.allows(population, one).item() for one in ahead]

    assert stands == enters == [True, True, True]
    assert drives == [False, False, True]


def test_places_that_nobody_holds_are_free(begun, books):
    begin, population = begun
    insertion_mask = room_of(begin, books, lane_m=1e6)
    population.presence[0, 1] = 0

    assert insertion_mask.allows(population, inserted(8, -2)).all()


def test_lanes_are_measured_along_their_whole_length(begun, books):
    begin, _ = begun
    insertion_mask = room_of(begin, books, lane_m=5.0)

    # Map tokens start every five metres: halfway between two the lane is as near.
    for x_m in (10.0, 11.0, 12.5):
        gap_m = insertion_mask.lane_distance_m(np.array([[x_m, 3.0]], dtype=np.float32))
        np.testing.assert_allclose(gap_m, 3.0, atol=0.05)


def test_each_rollout_is_asked_on_its_own_map(parked, drive, start, books, build_map):
    here = start(parked(1))
    elsewhere = start(drive(road_map=build_map([])))
    insertion_mask = make_insertion_mask(
        [here.history, elsewhere.history], books, np.array([1, 0, 0]), lane_m=5.0
    )
    population = place_logged_agents([elsewhere, here, here], min_rows=4)[-1]
    far = inserted(30, 20)
    three = InsertedAgents(
        **{name: np.repeat(getattr(far, name), 3, axis=0) for name in far.__slots__}
    )

    # A map without lanes asks for none.
    assert not (elsewhere.history.map_polyline_type == PolylineType.LANE).any()
    assert insertion_mask.allows(population, three).tolist() == [True, False, False]


def test_overlap_is_that_of_the_boxes_in_the_scene(begun, books):
    begin, population = begun
    insertion_mask = room_of(begin, books, lane_m=1e6)
    random = np.random.default_rng(0)
    for x_m, y_m, turned_rad in random.uniform([-8, -6, -3], [16, 6, 3], size=(200, 3)):
        pose = np.array([[x_m, y_m, turned_rad]], dtype=np.float32)
        on_somebody = boxes_overlap(
            pose,
            np.float32(SIZE[CAR][:2]),
            population.pose[0, :2],
            population.size_lwh_m[0, :2, :2],
        ).any()

        allowed = insertion_mask.allows(population, inserted(x_m, y_m, CAR, turned_rad))

        assert allowed.tolist() == [not on_somebody]
