import numpy as np

from infgen.metrics.road import NO_ROAD_M, road_edge_m
from tests.metrics.moving import boxes
from tests.spatial.test_road_edges import EAST

STEPS = slice(0, 11)
FIRST = np.array([0])


def test_a_car_that_crosses_an_edge_is_off_the_road_from_its_first_corner_on():
    # It drives south at 10 m/s from y = 6; its nose (2 m ahead) meets the edge after 4 m.
    car = boxes((10, 6, -np.pi / 2, 10))
    found = road_edge_m(car, FIRST, STEPS, EAST)[0, 0]

    np.testing.assert_allclose(found, -4.0 + np.arange(11), atol=1e-4)
    np.testing.assert_array_equal(found > 0, np.arange(11) > 4)


def test_who_is_not_there_has_no_distance():
    valid = np.ones((1, 11), bool)
    valid[0, 3] = False
    found = road_edge_m(boxes((10, 6, 0, 0), valid=valid), FIRST, STEPS, EAST)[0, 0]

    assert found[3] == NO_ROAD_M
    np.testing.assert_allclose(np.delete(found, 3), -5.0, atol=1e-5)
