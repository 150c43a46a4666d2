"""The states of a life, on validity patterns written by hand.

A pattern says which tokens are seen: ``x`` seen, ``.`` not. A life is written as ``E``
entering, ``p`` present, ``L`` leaving, ``.`` absent.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from infgen.tokens.presence import (
    first_token,
    gap_ends,
    has_motion,
    last_token,
    observed_tokens,
    presence_states,
    seen_tokens,
)
from infgen.tokens.scene_tokens import Presence

STATE = {
    ".": Presence.ABSENT,
    "p": Presence.PRESENT,
    "E": Presence.INSERTED,
    "L": Presence.REMOVED,
}
SEEN = arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=12))


def pattern(text):
    return np.array([[letter == "x" for letter in text]])


def life(text):
    return [[STATE[letter] for letter in text]]


@pytest.mark.parametrize(
    ("seen", "lived"),
    [
        pytest.param("xxxxxx", "Eppppp", id="there at the start enters at token 0"),
        pytest.param("..xxxx", "..Eppp", id="enters later"),
        pytest.param("xxxx..", "EppL..", id="leaves at the last token seen"),
        pytest.param("..xxxx", "..Eppp", id="the end of the log is no exit"),
        pytest.param("...xx.", "...EL.", id="a life of two tokens"),
        pytest.param("...x..", "...E..", id="a life of one token only enters"),
        pytest.param(".....x", ".....E", id="enters at the last token"),
        pytest.param("xx..xx", "Epp" + "ppp", id="present throughout a gap"),
        pytest.param("xx..x.", "EpppL.", id="leaves after a gap"),
        pytest.param("x...x.", "EpppL.", id="a gap right after entering"),
        pytest.param("......", "......", id="never seen"),
        pytest.param("x", "E", id="a log of one token"),
    ],
)
def test_life_of(seen, lived):
    np.testing.assert_array_equal(presence_states(pattern(seen)), life(lived))


def test_a_token_is_seen_if_the_agent_is_known_at_both_its_ends():
    valid = np.array([[True, True, False, True, True, True]])

    np.testing.assert_array_equal(seen_tokens(valid), pattern("x..xx"))


def test_first_and_last_tokens_of_nobody_are_outside_the_log():
    assert first_token(pattern("...")) == [3]
    assert last_token(pattern("...")) == [-1]
    assert first_token(pattern("..x.")) == [2]
    assert last_token(pattern("x.x.")) == [2]


@pytest.mark.parametrize(
    ("seen", "moves"), [("..xx", True), ("..x.", False), ("x.x.", False), ("x..xx", True)]
)
def test_only_two_tokens_in_a_row_give_a_move_to_learn(seen, moves):
    assert has_motion(pattern(seen)) == [moves]


def test_what_an_agent_does_while_it_enters_is_not_observed():
    seen = pattern("..xx.x")

    np.testing.assert_array_equal(
        observed_tokens(seen, presence_states(seen)), pattern("...x.x")
    )


@pytest.mark.parametrize(
    ("seen", "back"),
    [
        ("xx..xx", "...x.."),
        ("x.x.x.", ".x.x.."),
        ("..xxx.", "......"),
        ("xx....", "......"),
    ],
)
def test_a_chain_starts_anew_at_the_last_token_of_each_gap(seen, back):
    seen = pattern(seen)

    np.testing.assert_array_equal(gap_ends(seen, presence_states(seen)), pattern(back))


@given(SEEN)
def test_lives_are_well_formed(seen):
    presence = presence_states(seen)

    for row, known in zip(presence, seen, strict=True):
        states = "".join(".pEL"[state] for state in row).strip(".")
        assert "." not in states
        assert states.count("E") == known.any()
        assert not states or states[0] == "E"
        assert "L" not in states[:-1]
    assert not (presence[:, -1] == Presence.REMOVED).any()
    assert (presence[seen] != Presence.ABSENT).all()


@given(SEEN, st.data())
def test_the_past_does_not_know_the_future(seen, data):
    """Until an agent is gone, its states are those of the log cut short."""
    cut = data.draw(st.integers(1, seen.shape[1]))

    whole, short = presence_states(seen)[:, :cut], presence_states(seen[:, :cut])

    still_seen = seen[:, cut - 1]
    going = whole == Presence.REMOVED
    same = (whole == short) | going
    assert same[still_seen].all()
