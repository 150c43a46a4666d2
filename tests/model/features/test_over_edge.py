"""Whether a motion token that drives is likely depends on where the box is."""

import pytest
import torch

from infgen.model.features.edge_clearance import EdgesNear
from infgen.model.features.over_edge import DRIVES_M, KNOTS_M, OverEdgeHead
from infgen.scene import AgentType

LENGTH_M, WIDTH_M = 4.0, 2.0
X = torch.zeros((1, 16))
VEHICLE = torch.tensor([int(AgentType.VEHICLE)])
INSERTED = torch.tensor([True])


@pytest.fixture
def head(dense_moves):
    torch.manual_seed(0)
    return OverEdgeHead(16, dense_moves)


def beside(edges, left_m):
    """A box that lies along an edge, whose middle is so far to its left."""
    return EdgesNear.of(
        edges((0.0, 0.0, 0.0)),
        torch.tensor([[2.0, left_m, 0.0]]),
        torch.zeros((1, 2)),
        torch.tensor([[LENGTH_M, WIDTH_M]]),
        torch.zeros(1, dtype=torch.int64),
    )


@pytest.mark.parametrize(
    ("left_m", "passed"),
    [
        (3.0, [0, 0, 0, 0, 0, 0, 0]),
        (1.3, [1, 1, 0.5, 0, 0, 0, 0]),
        (0.95, [1, 1, 1, 1, 1, 0.5, 0]),
        (0.0, [1, 1, 1, 1, 1, 1, 1]),
        (-9.0, [1, 1, 1, 1, 1, 1, 1]),
    ],
)
def test_intervals_that_a_box_has_passed(head, edges, left_m, passed):
    """Its right side is a metre nearer to the edge than its middle."""
    found = head.passed(beside(edges, left_m), INSERTED)

    torch.testing.assert_close(found, torch.tensor([passed]).float(), atol=1e-4, rtol=0)


def test_without_edges_nothing_is_passed(head, edges):
    none = EdgesNear.of(
        edges(), *(torch.zeros((1, n)) for n in (3, 2, 2)), torch.zeros(1).long()
    )

    assert (head.passed(none, INSERTED) == 0).all()


def test_tokens_count_by_how_far_they_go(head, edges, dense_moves):
    """Odds of -2 over an edge: all of it where they drive, none where they stand."""
    torch.nn.init.zeros_(head.say.weight)
    head.say.bias.data = torch.full((len(KNOTS_M) - 1,), -2.0 / (len(KNOTS_M) - 1))

    logits = head(X, VEHICLE, head.passed(beside(edges, 0.0), INSERTED))

    end_m = torch.from_numpy(dense_moves.end_pose[int(AgentType.VEHICLE), :, :2])
    expected = -2 * (end_m.norm(dim=-1) / DRIVES_M).clamp(max=1)
    torch.testing.assert_close(logits[0], expected.float(), atol=1e-5, rtol=0)
    assert logits[0].min() == -2
    assert logits[0].max() == 0


def test_on_the_road_no_logit_changes(head, edges):
    logits = head(X, VEHICLE, head.passed(beside(edges, 4.0), INSERTED))

    assert (logits == 0).all()


def test_who_has_moved_is_not_told(head, edges):
    assert (head.passed(beside(edges, 0.0), ~INSERTED) == 0).all()
