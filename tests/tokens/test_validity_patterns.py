"""Token steps as five times yes or no."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from infgen.config import TokenSettings
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import Presence
from infgen.tokens.tokenizer import tokenize_scene
from infgen.tokens.validity_patterns import decode_patterns, encode_patterns

SHAPES = st.tuples(st.integers(0, 3), st.integers(1, 30))


def test_the_first_step_after_a_border_is_the_lowest_bit():
    valid = np.array([[1, *(1, 0, 0, 0, 0), *(0, 1, 1, 0, 1), 1, 1, 1]], dtype=bool)

    assert encode_patterns(valid).tolist() == [[1, 2 + 4 + 16]]


@given(SHAPES.flatmap(lambda shape: arrays(bool, shape)))
def test_patterns_decode_to_what_the_log_shows_but_for_step_0(valid):
    pattern = encode_patterns(valid)

    assert pattern.shape[1] == (valid.shape[1] - 1) // 5
    assert (pattern < 32).all()
    whole = 5 * pattern.shape[1] + 1
    np.testing.assert_array_equal(decode_patterns(pattern)[:, 1:], valid[:, 1:whole])
    assert not decode_patterns(pattern)[:, 0].any()


@given(SHAPES.flatmap(lambda shape: arrays(np.uint8, shape, elements=st.integers(0, 31))))
def test_what_patterns_decode_to_is_encoded_as_they_are(pattern):
    np.testing.assert_array_equal(encode_patterns(decode_patterns(pattern)), pattern)


def side_by_side(num_cars):
    """Poses [car, step, 3] of cars that drive abreast, the ego first."""
    x_m = np.arange(91.0)
    paths = [np.column_stack([x_m, 0 * x_m + 4 * row, 0 * x_m]) for row in range(num_cars)]
    return np.stack(paths)


@pytest.fixture
def tokens_of(build_scene, metre_moves, bent_roads):
    def run(path, valid):
        scene = build_scene(path, [AgentType.VEHICLE] * len(path), valid)
        return tokenize_scene(scene, metre_moves, bent_roads, TokenSettings())

    return run


def test_a_scenes_patterns_decode_to_the_log_wherever_an_agent_is_present(tokens_of):
    valid = np.random.default_rng(0).random((4, 91)) < 0.7
    valid[0, [0, 90]] = True
    valid[1:, [10, 20, 70]] = True
    valid[2, 30:60] = False
    valid[3, :8], valid[3, 71:] = False, False

    tokens = tokens_of(side_by_side(4), valid)

    present = np.repeat(tokens.presence != Presence.ABSENT, 5, axis=1)  # [agent, step - 1]
    assert tokens.num_agents == 4
    assert not present.all()
    np.testing.assert_array_equal(
        decode_patterns(tokens.pattern)[:, 1:], valid[:, 1:] & present
    )


def test_gaps_that_are_filled_show_in_the_pattern(tokens_of):
    valid = np.ones((2, 91), dtype=bool)
    valid[1, 22:24] = False

    tokens = tokens_of(side_by_side(2), valid)

    assert tokens.observed[1, 1:].all()
    assert tokens.pattern[1].tolist() == [31] * 4 + [31 - 2 - 4] + [31] * 13


def test_agents_beyond_the_range_are_patterned_as_the_log_shows_them(tokens_of):
    path = side_by_side(2)
    path[1, 31:60, 1] = 200.0

    tokens = tokens_of(path, np.ones((2, 91), dtype=bool))

    assert not tokens.observed[1, 7:10].any()
    assert (tokens.pattern[1] == 31).all()
