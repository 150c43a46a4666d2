"""Logits by what motion tokens change of the last move."""

import numpy as np
import pytest
import torch

from infgen.geometry import to_world
from infgen.model.features.last_move import LastMove, LastMoveHead
from infgen.model.features.motion_waves import wave_phases
from infgen.tokens.vocabulary import MotionVocabulary

WIDTH = 8


@pytest.fixture
def vocabulary():
    random = np.random.default_rng(0)
    end = random.uniform([0, -2, -0.5], [20, 2, 0.5], size=(3, 40, 3))
    path = end[:, :, None] * np.linspace(0, 1, 6)[:, None]
    size_lw_m = np.tile(np.float32([[4.8, 2.0]]), (3, 1))
    real = np.ones((3, 40), dtype=bool)
    return MotionVocabulary(size_lw_m, path.astype(np.float32), real)


@pytest.fixture
def head(vocabulary):
    """Weights that are alike for all agents: each wave is for no change."""
    head = LastMoveHead(WIDTH, vocabulary)
    head.begin_at_zero()
    waves = head.waves.shape[-1] // 2
    with torch.no_grad():
        head.weigh[-1].bias[:waves] = 1
    return head


def moves(vocabulary, tokens):
    """Last moves that are motion tokens, of vehicles."""
    change = torch.from_numpy(vocabulary.end_pose[0, tokens])
    return LastMove(change, torch.ones(len(tokens), dtype=torch.bool))


def test_last_move_is_the_pose_that_it_leads_to():
    random = np.random.default_rng(1)
    before = random.uniform(-3, 3, size=(50, 3)).astype(np.float32)
    change = random.uniform([-1, -2, -3], [20, 2, 3], size=(50, 3)).astype(np.float32)
    pose = to_world(change, before)

    last = LastMove.between(*map(torch.from_numpy, (before, pose)), torch.ones(50) > 0)

    np.testing.assert_allclose(last.change, change, atol=1e-5)


def test_likeliest_is_the_same_move_again(head, vocabulary):
    tokens = np.arange(40)
    last, vehicle = moves(vocabulary, tokens), torch.zeros(40, dtype=torch.int64)

    found = head(torch.randn(40, WIDTH), vehicle, last)

    assert found.argmax(dim=1).tolist() == tokens.tolist()
    assert found.max(dim=1).values.tolist() == pytest.approx([24.0] * 40, rel=1e-4)


def test_logits_are_waves_of_the_change(vocabulary):
    torch.manual_seed(0)
    head = LastMoveHead(WIDTH, vocabulary)
    x, last = torch.randn(5, WIDTH), moves(vocabulary, [3, 9, 11, 20, 39])

    found = head(x, torch.zeros(5, dtype=torch.int64), last)

    even, odd = head.weigh(x).chunk(2, dim=-1)
    ends = torch.from_numpy(vocabulary.end_pose[0])
    change = wave_phases(ends - last.change[:, None])  # [N, V, K]
    expected = (change.cos() * even[:, None] + change.sin() * odd[:, None]).sum(dim=-1)
    torch.testing.assert_close(found, expected, atol=2e-3, rtol=1e-3)


def test_who_has_no_last_move_is_told_nothing(head, vocabulary):
    last = moves(vocabulary, [4, 5])
    last = LastMove(last.change, torch.tensor([False, True]))

    found = head(torch.randn(2, WIDTH), torch.zeros(2, dtype=torch.int64), last)

    assert not found[0].any()
    assert found[1].any()


def test_untrained_it_changes_no_logit(vocabulary):
    head = LastMoveHead(WIDTH, vocabulary)
    head.begin_at_zero()

    found = head(
        torch.randn(2, WIDTH), torch.zeros(2, dtype=torch.int64), moves(vocabulary, [1, 2])
    )

    assert not found.any()
