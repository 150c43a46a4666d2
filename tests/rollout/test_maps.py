"""Maps of a batch are encoded once each, kept while there is room, and told apart."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.rollout.maps import RolloutMaps
from infgen.scene import FeatureType, LaneType


@pytest.fixture
def starts(drive, build_map, start):
    """Three scenes of one id with lanes of 50, 100 and 150 m: 10, 20 and 30 map tokens."""

    def lane(length_m):
        x_m = np.arange(0.0, length_m + 1)
        line = np.column_stack([x_m, 0 * x_m])
        return build_map([(1, FeatureType.LANE, LaneType.SURFACE_STREET, line)])

    return [start(drive(road_map=lane(length_m))) for length_m in (50, 100, 150)]


@pytest.fixture
def playing(simulator):
    """A simulator, and the numbers of map tokens that it has encoded."""
    made, encoded = simulator(), []
    encode = made.stepper.encode_maps

    def counted(roads):
        encoded.append(int(roads.real.sum()))
        return encode(roads)

    made.stepper.encode_maps = counted
    return made, encoded


def tokens(maps):
    return maps.features.real.sum(dim=1).tolist()


def test_a_map_is_encoded_once_however_many_rollouts_are_on_it(playing, starts):
    made, encoded = playing
    one, other, _ = starts

    maps = RolloutMaps(made, [one, other, replace(one, index=1)])
    maps.hold([other, replace(other, index=1)], most=2)

    assert encoded == [30]
    assert tokens(maps) == [10, 20]
    assert maps.number([other, one, other]).tolist() == [1, 0, 1]


def test_maps_beyond_the_most_are_forgotten_but_those_in_use_are_not(playing, starts):
    made, encoded = playing
    one, other, third = starts
    maps = RolloutMaps(made, [one])

    maps.hold([other, third], most=2)
    assert tokens(maps) == [20, 30]
    maps.hold([one, other, third], most=1)

    assert sorted(tokens(maps)) == [10, 20, 30]
    assert encoded == [10, 50, 10]


def test_maps_encoded_one_by_one_are_those_encoded_together(simulator, starts):
    made = simulator()
    together, later = RolloutMaps(made, starts), RolloutMaps(made, starts[:1])
    later.hold(starts, most=3)
    number = later.number(starts)

    for at in range(3):
        rows = [
            maps.features.features[
                maps.features.rows.number[scene][maps.features.real[scene]]
            ]
            for maps, scene in ((together, at), (later, number[at]))
        ]
        torch.testing.assert_close(*rows, atol=1e-5, rtol=1e-5)
