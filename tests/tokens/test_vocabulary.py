import numpy as np
import pytest

from infgen.tokens.vocabulary import BOX_LW_M, MapVocabulary, MotionVocabulary


@pytest.fixture
def one_metre_ahead():
    path = np.zeros((3, 2, 6, 3), np.float32)
    path[:, 1, :, 0] = np.linspace(0, 1, 6)
    return MotionVocabulary(BOX_LW_M, path, np.zeros((3, 2), bool))


def test_boxes_are_those_of_the_vocabulary_not_swapped_between_pedestrian_and_cyclist():
    # Upstream InfGen swapped the last two when matching.
    np.testing.assert_array_equal(BOX_LW_M, np.float32([[4.8, 2.0], [1, 1], [2, 1]]))


def test_corners_at_the_end_are_those_of_the_kinds_box_moved(one_metre_ahead):
    corners = one_metre_ahead.end_corners_m
    assert corners.shape == (3, 2, 4, 2)
    np.testing.assert_allclose(corners[0, 1, 0], [3.4, 1.0], atol=1e-6)  # front left
    np.testing.assert_allclose(corners[1, 1, 0], [1.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(corners[2, 1, 0], [2.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(corners.mean(axis=2), one_metre_ahead.end_pose[..., :2])


def test_end_poses_are_the_last_of_each_path(one_metre_ahead):
    assert one_metre_ahead.num_motion_tokens == 2
    np.testing.assert_array_equal(one_metre_ahead.end_pose[:, 1], [[1, 0, 0]] * 3)


def test_roads_are_sampled_at_first_middle_and_last_point():
    curve = np.stack([0.5 * np.arange(11), np.zeros(11)], axis=-1)[None]
    vocabulary = MapVocabulary(curve.astype(np.float32), np.ones(1, bool))
    assert vocabulary.num_map_tokens == 1
    np.testing.assert_array_equal(vocabulary.sample_m, [[[0, 0], [2.5, 0], [5, 0]]])
