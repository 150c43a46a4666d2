"""Recovery: how much of a deviation from the log an agent is to make good."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from infgen.model.batching.frames import to_local, to_world
from infgen.model.batching.recovery import WHOLE_RECOVERY, Recovery
from infgen.model.training_settings import TrainSettings


def poses(*rows):
    return torch.tensor(rows, dtype=torch.float32)


NORTH = math.pi / 2
LOGGED, NEXT = poses([10, 20, NORTH]), poses([10, 25, NORTH])


def test_a_whole_recovery_leads_to_the_log_itself():
    away = poses([11, 22, 2.0])
    assert WHOLE_RECOVERY.target(away, LOGGED, NEXT) is NEXT


def test_who_is_ahead_stays_ahead_by_what_is_not_made_good():
    ahead = poses([10, 22, NORTH])
    found = Recovery(along=0.25, lateral=1.0).target(ahead, LOGGED, NEXT)
    np.testing.assert_allclose(found, [[10, 26.5, NORTH]], atol=1e-5)


def test_who_is_aside_comes_back_in_a_curve_and_faces_where_it_leads():
    aside = poses([8, 20, NORTH])  # 2 m to the left of a way to the north.
    found = Recovery(along=1.0, lateral=0.25).target(aside, LOGGED, NEXT)
    turned = math.atan2(-0.5, 5)
    np.testing.assert_allclose(found, [[8.5, 25, NORTH + turned]], atol=1e-5)


def test_who_stands_in_the_log_keeps_what_is_left_of_its_heading():
    stands = poses([8, 20, NORTH + 0.4])
    found = Recovery(along=0.0, lateral=0.5).target(stands, LOGGED, LOGGED)
    np.testing.assert_allclose(found, [[9, 20, NORTH + 0.2]], atol=1e-5)


def test_who_is_where_the_log_has_it_goes_on_as_the_log_does():
    turning = poses([9, 25, NORTH + 0.5])
    found = Recovery(along=0.0, lateral=0.0).target(LOGGED, LOGGED, turning)
    np.testing.assert_allclose(found, turning, atol=1e-5)


@given(st.integers(0, 2**31), st.floats(0, 1), st.floats(0, 1))
def test_targets_turn_and_move_with_the_scene(seed, along, lateral):
    random = torch.Generator().manual_seed(seed)
    rows = [torch.randn((5, 3), generator=random) for _ in range(3)]
    frame = 3 * torch.randn(3, generator=random).expand(5, 3)
    recovery = Recovery(along, lateral)

    here = recovery.target(*rows)
    there = recovery.target(*(to_world(each, frame) for each in rows))

    away = to_local(there, frame) - here
    away[:, 2] = torch.remainder(away[:, 2] + math.pi, 2 * math.pi) - math.pi
    np.testing.assert_allclose(away, torch.zeros_like(away), atol=1e-4)


@pytest.mark.parametrize("name", ["along_recovery", "lateral_recovery"])
@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_a_share_is_from_none_to_all(name, share):
    with pytest.raises(ValueError, match=name):
        TrainSettings(**{name: share})
