"""Cells are told which way lanes lead there, as seen from the ego."""

import math
from dataclasses import replace

import pytest
import torch

from infgen.model.batching.batch import collate
from infgen.model.features.polyline_segments import lane_centres
from infgen.model.insertion.lane_directions import LanesAround, ways_of_lanes
from infgen.tokens.map import PolylineType

EAST, NORTH, WEST = 0.0, math.pi / 2, math.pi
EGO = torch.tensor([[10.0, 0.0, NORTH]])
"""It faces north: what lies east of it is at its right, +x of its grid frame."""


@pytest.fixture
def around(lines):
    def lie(*poses):
        lanes = lane_centres(lines(PolylineType.LANE, *poses))
        middle_m = lanes.start_m + lanes.along_m / 2
        return LanesAround(middle_m, lanes.along_m, lanes.real)

    return lie


@pytest.mark.parametrize(
    ("heading_rad", "start_x_m", "ways"),
    [(EAST, 27.5, (1, 0, 0)), (WEST, 32.5, (0, 1, 0)), (NORTH, 30.0, (0, 0, 1))],
)
def test_ways_are_away_from_the_ego_towards_it_and_past_it(
    around, heading_rad, start_x_m, ways
):
    start_y_m = -2.5 if heading_rad == NORTH else 0.0
    xy_m, found = ways_of_lanes(EGO, around((start_x_m, start_y_m, heading_rad)))

    torch.testing.assert_close(xy_m[0, 0], torch.tensor([20.0, 0.0]), atol=1e-4, rtol=0)
    torch.testing.assert_close(found[0, 0], torch.tensor(ways).float(), atol=1e-5, rtol=0)


def test_which_way_the_ego_faces_does_not_matter(around):
    lanes = around((27.5, 3.0, EAST), (4.0, -20.0, NORTH), (-30.0, 8.0, WEST))
    turned = EGO + torch.tensor([[0.0, 0.0, 1.2]])

    assert torch.equal(ways_of_lanes(EGO, lanes)[1], ways_of_lanes(turned, lanes)[1])


@pytest.fixture
def network(tiny, new_network):
    refined = {"cell_refinement_width": 8, "cell_lane_directions": True}
    return new_network(replace(tiny, **refined)).eval()


def test_it_changes_where_agents_are_inserted_and_not_whether(network, record, limits):
    batch = collate([record(3, tokens=9), record(4, agents=9)], limits, 7)
    refinement = network.cells.cell_features.refinement
    with torch.no_grad():
        refinement.key.weight.normal_()
        before = network(batch).entries
        refinement.lanes.say.weight.normal_()

        after = network(batch).entries

    assert torch.equal(before.add_logit, after.add_logit)
    assert not torch.allclose(before.position_logits, after.position_logits)


def test_without_a_refinement_there_is_none(tiny, new_network):
    network = new_network(replace(tiny, cell_lane_directions=True))

    assert not [name for name, _ in network.named_parameters() if "lanes" in name]
