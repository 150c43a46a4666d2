"""Moves told from where they lead."""

import numpy as np
import pytest
import torch

from infgen.model.motion_head import MotionHead
from infgen.tokens.vocabulary import BOX_LW_M, MotionVocabulary

WIDTH, FEATURES = 16, 12


def row_of_moves(kinds=3, spacing_m=0.1, count=40):
    """Straight ahead, each move a little longer, each kind's a little shorter."""
    path = np.zeros((kinds, count, 6, 3), np.float32)
    length_m = spacing_m * np.arange(count) * np.array([[1.0], [0.8], [0.6]])
    path[..., 0] = length_m[..., None] * np.linspace(0, 1, 6)
    return MotionVocabulary(BOX_LW_M, path, np.ones((kinds, count), bool))


@pytest.fixture
def head():
    torch.manual_seed(0)
    return MotionHead(WIDTH, FEATURES, row_of_moves())


def features(rows, seed=0):
    return torch.randn(rows, WIDTH, generator=torch.Generator().manual_seed(seed))


def test_every_row_is_told_by_its_own_kinds_moves_whoever_is_beside_it(head):
    torch.nn.init.normal_(head.usual)
    x, agent_type = features(7), torch.tensor([2, 0, 1, 0, 0, 2, 1])

    together = head(x, agent_type, head.table())

    for row in range(7):
        alone = head(x[row : row + 1], agent_type[row : row + 1], head.table())
        torch.testing.assert_close(together[row], alone[0])
        by_hand = (
            head.wanted(x[row]) @ head.table()[agent_type[row]].T
            + head.usual[agent_type[row]]
        )
        torch.testing.assert_close(together[row], by_hand)


def test_moves_that_end_in_one_place_are_told_alike():
    torch.manual_seed(0)
    book = row_of_moves()
    book.path[:, 7] = book.path[:, 3]

    head = MotionHead(WIDTH, FEATURES, book)

    logits = head(features(5), torch.zeros(5, dtype=torch.int64), head.table())

    torch.testing.assert_close(logits[:, 7], logits[:, 3])


def test_no_two_moves_a_centimetre_apart_look_the_same(head):
    waves = MotionHead(WIDTH, FEATURES, row_of_moves(spacing_m=0.01)).waves[0]

    gap = (waves[:, None] - waves).abs().amax(dim=-1)
    gap.fill_diagonal_(1.0)

    assert gap.min() > 0.02


def test_what_is_learned_of_one_move_is_learned_of_those_beside_it(head):
    x, agent_type = features(1), torch.zeros(1, dtype=torch.int64)
    head.usual.requires_grad_(False)
    optimiser = torch.optim.SGD([p for p in head.parameters() if p.requires_grad], 0.02)
    before = head(x, agent_type, head.table())[0].detach()

    loss = torch.nn.functional.cross_entropy(
        head(x, agent_type, head.table()), torch.tensor([20])
    )
    loss.backward()
    optimiser.step()
    gained = head(x, agent_type, head.table())[0].detach() - before

    assert gained[20] > 0
    assert gained[18:23].mean() > 2 * gained[:10].mean()
    assert gained[18:23].mean() > 2 * gained[31:].mean()


def test_nobody_is_told_nothing(head):
    assert head(features(0), torch.zeros(0, dtype=torch.int64), head.table()).shape == (
        0,
        40,
    )
