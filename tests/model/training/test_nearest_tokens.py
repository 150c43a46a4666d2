"""What tensors find is what arrays find."""

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from infgen import geometry
from infgen.model.batching.frames import to_local, to_world
from infgen.model.training.nearest_tokens import (
    MotionTokenEnds,
    nearest,
    nearest_of,
)
from infgen.tokens.motion_tokens import advance, make_match_table, nearest_motion_tokens
from infgen.tokens.vocabulary import BOX_LW_M, MotionVocabulary

CPU = torch.device("cpu")


def random_codebook(rng, moves=200):
    end = rng.normal(size=(3, moves, 3)) * [8.0, 1.0, 0.6]
    end[:, 0] = 0
    end[:, moves // 2] = end[:, 1]  # twins
    path = end[:, :, None] * np.linspace(0, 1, 6)[:, None]
    return MotionVocabulary(BOX_LW_M, path.astype(np.float32), np.ones((3, moves), bool))


def poses(rng, rows, far_m=30.0):
    pose = rng.normal(size=(rows, 3)) * [far_m, far_m, 1.5]
    return pose.astype(np.float32)


@given(
    st.integers(0, 2**32),
    st.sampled_from([0.01, 0.3, 3.0, 300.0]),
    st.sampled_from([0, 1, 40, 2500]),
)
@example(0, 300.0, 2500)
@settings(max_examples=40)
def test_the_nearest_move_is_the_same_on_tensors(seed, stray, rows):
    rng = np.random.default_rng(seed)
    vocabulary = random_codebook(rng)
    agent_type = rng.integers(0, 3, rows).astype(np.int8)
    pose = poses(rng, rows)
    ahead = advance(
        pose, agent_type, rng.integers(0, 200, rows).astype(np.int16), vocabulary
    )
    target = ahead + (rng.normal(size=(rows, 3)) * stray).astype(np.float32)

    wanted = torch.from_numpy(geometry.to_local(target, pose))
    ends = MotionTokenEnds.of(vocabulary, CPU)
    found = nearest(wanted, torch.from_numpy(agent_type).long(), ends)

    expected = nearest_motion_tokens(target, pose, agent_type, make_match_table(vocabulary))
    np.testing.assert_array_equal(found.numpy(), expected)


@given(st.integers(0, 2**32))
@settings(max_examples=20)
def test_the_nearest_of_all_moves_is_the_nearest(seed):
    rng = np.random.default_rng(seed)
    ends = MotionTokenEnds.of(random_codebook(rng), CPU)
    wanted = torch.from_numpy(poses(rng, 60, far_m=4.0))
    agent_type = torch.from_numpy(rng.integers(0, 3, 60))
    everything = torch.arange(200).expand(60, 200)

    assert torch.equal(
        nearest_of(wanted, agent_type, everything, ends), nearest(wanted, agent_type, ends)
    )


def test_the_nearest_of_some_is_among_them_and_the_first_of_twins():
    rng = np.random.default_rng(0)
    vocabulary = random_codebook(rng)
    ends = MotionTokenEnds.of(vocabulary, CPU)
    wanted = torch.from_numpy(vocabulary.end_pose[0, [1, 1, 7]])
    agent_type = torch.zeros(3, dtype=torch.int64)
    choice = torch.tensor([[1, 7, 100], [7, 100, 1], [7, 9, 3]])

    assert nearest_of(wanted, agent_type, choice, ends).tolist() == [1, 100, 7]


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_search_is_exact_under_autocast(dtype):
    rng = np.random.default_rng(1)
    vocabulary = random_codebook(rng)
    ends = MotionTokenEnds.of(vocabulary, CPU)
    wanted = torch.from_numpy(vocabulary.end_pose[1])
    agent_type = torch.ones(200, dtype=torch.int64)

    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=dtype == torch.bfloat16):
        found = nearest(wanted, agent_type, ends)

    expected = torch.arange(200)
    expected[100] = 1  # twins
    assert torch.equal(found, expected)


def test_poses_change_frames_as_arrays_do():
    rng = np.random.default_rng(2)
    pose, frame = poses(rng, 500), poses(rng, 500)
    on_tensors = torch.from_numpy(pose), torch.from_numpy(frame)

    local, world = to_local(*on_tensors), to_world(*on_tensors)

    np.testing.assert_allclose(local, geometry.to_local(pose, frame), atol=1e-4)
    np.testing.assert_allclose(world, geometry.to_world(pose, frame), atol=1e-4)
    back = to_world(local, on_tensors[1])[:, :2]
    np.testing.assert_allclose(back, pose[:, :2], atol=1e-3)
