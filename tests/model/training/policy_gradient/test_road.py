"""The road of a map, drawn from its map tokens."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.model.batching.batch import collate
from infgen.model.training.policy_gradient.road import read_roads
from infgen.tokens.map import PolylineType
from infgen.tokens.vocabulary import MapVocabulary


@pytest.fixture
def straight():
    """A vocabulary of one shape: five metres straight ahead."""
    curve_m = np.zeros((1, 11, 2), dtype=np.float32)
    curve_m[0, :, 0] = 0.5 * np.arange(11)
    return MapVocabulary(curve_m, np.ones(1, dtype=bool))


@pytest.fixture
def roads(record, limits):
    """Six map tokens in a row along x from -10 m on, four metres to the right."""
    found = collate([record(0, roads=6)], limits, 0).roads
    pose = torch.zeros_like(found.pose)
    pose[0, :, 0] = 5 * torch.arange(6) - 10
    pose[0, :, 1] = -4
    follows = torch.ones_like(found.follows)
    follows[:, 0] = False
    edge = torch.full_like(found.polyline_type, int(PolylineType.ROAD_EDGE))
    token = torch.zeros_like(found.token)
    return replace(found, pose=pose, token=token, polyline_type=edge, follows=follows)


def off_m(road, y_m):
    return float(road.off_m(np.float32([[5, y_m, 0]]), np.float32([[4, 2]]))[0])


def test_the_road_is_on_the_left_of_its_edges(roads, straight):
    (road,) = read_roads(roads, straight)

    assert off_m(road, 0.0) == pytest.approx(-3.0)
    assert off_m(road, -5.0) == pytest.approx(2.0)


def test_tokens_that_follow_each_other_are_one_line(roads, straight):
    (road,) = read_roads(roads, straight)
    (apart,) = read_roads(replace(roads, follows=roads.follows & False), straight)

    assert len(road.edges.start_m) == len(apart.edges.start_m) == 12
    assert (road.edges.before < 0).sum() == 1
    assert (apart.edges.before < 0).sum() == 6


def test_lanes_and_padding_are_no_edges(roads, straight):
    lane = torch.full_like(roads.polyline_type, int(PolylineType.LANE))
    (road,) = read_roads(replace(roads, polyline_type=lane), straight)
    (empty,) = read_roads(replace(roads, real=roads.real & False), straight)

    assert road.edges is None
    assert len(road.lane_start_m) == 6
    assert road.lane_along_m[0].tolist() == [5, 0, 0]
    assert off_m(road, 0.0) == off_m(empty, 0.0) == -np.inf
