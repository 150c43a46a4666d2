"""Road edges of towns: they lie beside the lanes, not across them."""

import numpy as np
import pytest

from infgen.scene import RoadEdgeType
from infgen.sources.towns.streets.layouts import draw_layout
from infgen.sources.towns.streets.network import read_network
from infgen.sources.towns.streets.plain_xml import build_net
from infgen.sources.towns.streets.road_edges import draw_road_edges
from infgen.sources.towns.streets.topology import draw_skeleton
from infgen.sources.towns.variety import BROAD
from tests.sources.towns.conftest import needs_sumo


def crosses(one_m, other_m):
    """Tell whether two lines of points cross."""

    def cross(first, second):
        return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]

    one, other = np.diff(one_m, axis=0)[:, None], np.diff(other_m, axis=0)[None]
    between = other_m[None, :-1] - one_m[:-1, None]
    with np.errstate(all="ignore"):
        shares = [cross(between, side) / cross(one, other) for side in (other, one)]
    return bool(np.all([(share >= 0) & (share <= 1) for share in shares], axis=0).any())


def touches(one_m, other_m):
    """Tell whether the upright boxes around two lines of points meet."""
    low = np.maximum(one_m.min(axis=0), other_m.min(axis=0))
    return bool((low <= np.minimum(one_m.max(axis=0), other_m.max(axis=0))).all())


def boundaries(network):
    return [
        edge.xy_m for edge in draw_road_edges(network) if edge.kind is RoadEdgeType.BOUNDARY
    ]


def across(network):
    """Count the road edges of a town that cross a lane or a way over a junction."""
    lanes = [lane.xy_m for edge in network.edges.values() for lane in edge.driven]
    driven = [*lanes, *(way.xy_m for way in network.connectors)]
    return sum(
        any(touches(xy_m, way_m) and crosses(xy_m, way_m) for way_m in driven)
        for xy_m in boundaries(network)
    )


def test_no_road_edge_of_a_crossing_crosses_a_lane(crossing):
    assert len(boundaries(crossing)) == 8
    assert across(crossing) == 0


@needs_sumo
@pytest.mark.parametrize("seed", [6, 8])
def test_road_edges_keep_beside_the_lanes_where_streets_meet_at_acute_angles(
    seed, tmp_path
):
    rng = np.random.default_rng(seed)
    skeleton = draw_skeleton(tmp_path, rng, 1.0, BROAD.streets)
    layout = draw_layout(skeleton, rng, BROAD.streets)
    network = read_network(build_net(layout, tmp_path, rng, BROAD.streets))

    assert across(network) == 0
