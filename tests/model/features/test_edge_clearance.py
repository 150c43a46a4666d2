"""Motion tokens are told apart by how far they lead over road edges."""

import numpy as np
import pytest
import torch

from infgen.model.features.anchors import Anchors
from infgen.model.features.edge_clearance import (
    KNOTS_M,
    POINTS,
    EdgeClearance,
    EdgesNear,
)
from infgen.scene import AgentType
from infgen.tokens.map import PolylineType

LENGTH_M, WIDTH_M = 4.0, 2.0
AT_ORIGIN = (0.0, 0.0, 0.0)


@pytest.fixture
def clearance(dense_moves):
    torch.manual_seed(0)
    return EdgeClearance(16, 8, dense_moves)


def near(found, *poses):
    count = len(poses)
    return EdgesNear.of(
        found,
        torch.tensor(poses, dtype=torch.float32),
        torch.zeros((count, 2)),
        torch.tensor([LENGTH_M, WIDTH_M]).expand(count, 2),
        torch.zeros(count, dtype=torch.int64),
    )


def front_over_m(found, *poses):
    """How far the fronts of boxes at poses are over the nearest edge."""
    at_front = torch.tensor([0.0, 0.0, 1.0, 0.0, -1.0]).view(1, 5, 1)
    return near(found, *poses).over_m(at_front)[:, 0].tolist()


RIGHT = [(x, -3.0, 0.0) for x in (-10.0, -5.0, 0.0, 5.0)]
"""An edge three metres to the right of an agent at the origin, the road on its left."""


def test_how_far_a_box_is_over_an_edge_is_its_half_width_more_than_its_middle(edges):
    found = edges(*RIGHT)

    over_m = front_over_m(found, AT_ORIGIN, (0, -2, 0), (0, -3.5, 0), (0, -2, -np.pi / 2))

    assert over_m == pytest.approx([-2.0, 0.0, 1.5, 1.0], abs=1e-5)


def test_beyond_an_end_the_distance_is_that_of_the_end(edges):
    over_m = front_over_m(edges((0.0, 3.0, np.pi)), (3.0 - 1.0, 7.0, 0.0))

    assert over_m == pytest.approx([5.0 + 1.0], abs=1e-5)


def test_pieces_end_where_the_next_ones_begin(edges):
    bent = edges((0.0, -3.0, 0.0), (4.0, -2.0, 0.0), follows=[False, True])

    assert bent.along_m[0].tolist() == [[4.0, 1.0], [5.0, 0.0]]
    apart = edges((0.0, -3.0, 0.0), (4.0, -2.0, 0.0))
    assert apart.along_m[0].tolist() == [[5.0, 0.0], [5.0, 0.0]]


@pytest.mark.parametrize("aside_m", [0.3, -0.3])
def test_ahead_of_a_tip_the_edge_with_a_point_more_to_its_side_tells_the_side(
    aside_m, edges
):
    tip = edges((-5.0, 0.0, 0.0), (0.0, 0.0, np.pi + 0.2), follows=[False, True])
    assert front_over_m(tip, (-3.0, 1.0, 0.0)) == pytest.approx([0.0], abs=1e-5)
    assert front_over_m(tip, (-3.0, -0.2, 0.0))[0] > WIDTH_M / 2

    over_m = front_over_m(tip, (0.0, aside_m, 0.0))

    assert over_m[0] < WIDTH_M / 2


def test_without_edges_nothing_is_over_one(clearance, edges):
    kind = torch.zeros(1, dtype=torch.int64)
    for found in (edges(), edges((500.0, 0.0, 0.0)), edges(*RIGHT, kind=PolylineType.LANE)):
        assert front_over_m(found, AT_ORIGIN) == [-np.inf]
        assert not clearance.features(kind, near(found, AT_ORIGIN)).any()


def test_features_are_how_far_anchors_lead_over_edges(clearance, dense_moves, edges):
    anchors = Anchors.of(dense_moves)
    kind = torch.full((1,), int(AgentType.VEHICLE))
    pose = (0.0, -1.5, -0.3)

    told = clearance.features(kind, near(edges(*RIGHT), pose))[0]

    intervals = len(KNOTS_M) - 1
    assert told.shape == (clearance.anchors, intervals * (len(POINTS) + 2))
    for anchor in range(0, clearance.anchors, 5):
        end = anchors.end_pose[AgentType.VEHICLE, anchor]
        for place, (time_s, side) in enumerate((*POINTS, (0, 1), (0, -1))):
            if time_s:
                x_m, y_m = anchors.place_m(time_s)[AgentType.VEHICLE, anchor]
                heading_rad = end[2]
            else:
                x_m = y_m = heading_rad = 0
            middle_m = side * (LENGTH_M - WIDTH_M) / 2
            x_m = x_m + middle_m * np.cos(heading_rad)
            y_m = y_m + middle_m * np.sin(heading_rad)
            world_y_m = pose[1] + np.sin(pose[2]) * x_m + np.cos(pose[2]) * y_m
            if pose[0] + np.cos(pose[2]) * x_m - np.sin(pose[2]) * y_m > 10:
                continue  # Beyond the last edge.
            over_m = -3 - world_y_m + WIDTH_M / 2
            wanted = np.clip((over_m - KNOTS_M[:-1]) / np.diff(KNOTS_M), 0, 1)
            part = told[anchor, place * intervals : (place + 1) * intervals]
            np.testing.assert_allclose(part, wanted, atol=2e-5)


def test_features_are_the_same_wherever_the_scene_lies(clearance, edges):
    def moved(pose):
        return (40.0 - pose[1], 7.0 + pose[0], pose[2] + np.pi / 2)

    poses = [*RIGHT, (12.0, 3.0, 2.0), (14.0, 5.0, 3.0)]
    kind = torch.tensor([0, 1])
    agents = [AT_ORIGIN, (2.0, -1.0, 0.4)]

    here = clearance.features(kind, near(edges(*poses), *agents))
    there = clearance.features(kind, near(edges(*map(moved, poses)), *map(moved, agents)))

    torch.testing.assert_close(here, there, rtol=1e-4, atol=1e-4)


def test_rows_at_once_change_nothing(clearance, monkeypatch, edges):
    kind, found = torch.zeros(3, dtype=torch.int64), edges(*RIGHT)
    agents = near(found, AT_ORIGIN, (2.0, -1.0, 0.4), (0.0, -3.0, 1.0))
    together = clearance.features(kind, agents)

    monkeypatch.setattr("infgen.model.features.anchors.ROWS", 2)

    assert torch.equal(together, clearance.features(kind, agents))


def test_before_training_no_logit_changes_and_then_tokens_are_told_apart(clearance, edges):
    kind, x = torch.zeros(1, dtype=torch.int64), torch.randn(1, 16)
    agents = near(edges(*RIGHT), AT_ORIGIN)
    clearance.begin_at_zero()
    assert not clearance(x, kind, agents).any()

    torch.nn.init.normal_(clearance.ask[-1].weight)

    assert clearance(x, kind, agents).std() > 0
