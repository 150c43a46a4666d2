"""Coordinates of pairs: known ones, and independence of the frame they are computed in."""

import math

import pytest
import torch

from infgen.model.rotary.coordinates import coordinates
from infgen.model.rotary.relation import RotaryRelation
from infgen.model.settings import NUM_COORDINATES


def test_a_car_that_crosses_six_metres_ahead_is_described_so():
    target = torch.tensor([[3.0, 4.0, math.pi / 2]])  # Faces north.
    source = torch.tensor([[[3.0, 10.0, math.pi]]])  # Ahead of it, faces west.
    ago = torch.tensor([[-4.0]])

    found = coordinates(target, source, ago)[0, 0]

    # The target is to the left of who faces west north of it. 6 m are 1.5 units of 4 m,
    # and 0.4 of the 15 m that are squared.
    expected = [1.5, 0, 0.16, 0, 0, 0, 1.5, 0.16, 0, 1, -0.5, 0.25]
    torch.testing.assert_close(found, torch.tensor(expected), atol=1e-6, rtol=0)
    assert len(found) == NUM_COORDINATES


@pytest.mark.parametrize("shift_m", [0.0, 300.0, 8000.0])
def test_the_frame_does_not_matter(shift_m):
    torch.manual_seed(0)
    pose = torch.randn(6, 3) * torch.tensor([20.0, 20.0, 2.0])
    turn_rad = 1.1
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    x, y, heading_rad = pose.double().unbind(-1)
    moved = torch.stack(
        [cos * x - sin * y + shift_m, sin * x + cos * y - shift_m, heading_rad + turn_rad],
        dim=-1,
    ).float()

    def described(pose):
        return coordinates(pose[:2], pose[2:].expand(2, -1, -1))

    # Positions of 8 km are rounded to a millimetre.
    torch.testing.assert_close(described(moved), described(pose), atol=1e-3, rtol=1e-3)


def test_a_score_of_coordinates_is_a_product_of_query_and_key():
    """For each query there is a vector, of it alone, whose product with one of each key."""
    torch.manual_seed(0)
    targets, sources = torch.randn(40, 3).double(), torch.randn(50, 3).double()
    found = coordinates(targets, sources.expand(40, -1, -1))

    for number in range(NUM_COORDINATES):
        rank = int(torch.linalg.matrix_rank(found[..., number], rtol=1e-9))
        assert rank <= 9, number  # Of 40: a few numbers of each token are enough.


def test_the_part_has_nothing_to_learn_and_no_table():
    relation = RotaryRelation(16)

    assert not list(relation.parameters())
    assert not relation.table().numel()
    assert relation.turn(torch.zeros(5, 3)).shape == (5, 8)
