"""Turned features meet by how headings and times differ, and by nothing else."""

import math

import pytest
import torch

from infgen.model.rotary.turns import (
    CYCLE_TOKENS,
    multiples,
    turn_of,
    turned,
    turned_back,
)

WIDTH = 16
OF_EACH = multiples(WIDTH)


def facing(*heading_rad):
    """Poses somewhere, with these headings."""
    return torch.tensor([[30.0 * i, -7.0, rad] for i, rad in enumerate(heading_rad)])


@pytest.fixture
def features():
    torch.manual_seed(0)
    return torch.randn(3, WIDTH)


def products(features, pose, token=0.0):
    shown = turned(features, turn_of(pose, OF_EACH, token))
    return shown @ shown.mT


def test_products_depend_on_relative_headings_only(features):
    pose = facing(0.3, -2.0, 3.0)
    other = pose + torch.tensor([100.0, -40.0, 1.7])

    torch.testing.assert_close(products(features, other), products(features, pose))
    assert not torch.allclose(products(features, pose), features @ features.mT)


def test_products_depend_on_time_differences_only(features):
    pose, token = facing(0.3, -2.0, 3.0), torch.tensor([0.0, 3.0, 11.0])

    for later in (5.0, 3000.0):
        torch.testing.assert_close(
            products(features, pose, token + later), products(features, pose, token)
        )
    assert not torch.allclose(products(features, pose, token), products(features, pose))


def test_a_full_turn_and_a_full_cycle_change_nothing(features):
    once = turn_of(facing(1.0), OF_EACH, 2.0)

    torch.testing.assert_close(turn_of(facing(1.0 + 2 * math.pi), OF_EACH, 2.0), once)
    torch.testing.assert_close(turn_of(facing(1.0), OF_EACH, 2.0 + CYCLE_TOKENS), once)


def test_a_quarter_turn_is_one_of_each_pair_by_its_harmonic():
    ones = turned(torch.tensor([1.0, 0.0] * 8), turn_of(facing(math.pi / 2), OF_EACH)[0])

    # Pairs 0 to 3 stay, 4, 5 and 7 turn by a quarter, 6 by a half.
    expected = [[1.0, 0.0]] * 4 + [[0.0, 1.0]] * 2 + [[-1.0, 0.0], [0.0, 1.0]]
    torch.testing.assert_close(ones.view(8, 2), torch.tensor(expected), atol=1e-6, rtol=0)


def test_turning_back_is_the_inverse_and_the_transpose(features):
    turn, other = turn_of(facing(0.3, -2.0, 3.0), OF_EACH, 4.0), torch.randn(3, WIDTH)

    torch.testing.assert_close(turned_back(turned(features, turn), turn), features)
    torch.testing.assert_close(
        (turned(features, turn) * other).sum(), (features * turned_back(other, turn)).sum()
    )
    assert turned(features, None) is features


def test_features_of_half_the_bits_keep_their_precision_outside(features):
    rough = turned(features.bfloat16(), turn_of(facing(0.3, -2.0, 3.0), OF_EACH))

    assert rough.dtype == torch.bfloat16


def test_of_nobody_there_is_nothing_to_turn():
    empty = turned(torch.zeros(0, WIDTH), turn_of(torch.zeros(0, 3), OF_EACH))

    assert empty.shape == (0, WIDTH)
