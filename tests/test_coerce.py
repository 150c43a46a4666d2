"""Plain values become settings of the right types, exactly or not at all."""

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.config import check_numbers, coerce
from infgen.errors import ConfigError
from infgen.settings import build


@given(st.integers(-(2**80), 2**80))
def test_an_int_keeps_all_its_digits_as_a_number_and_as_a_word(number):
    assert coerce(number, int, "seed") == number
    assert coerce(str(number), int, "seed") == number
    assert coerce(number, int | None, "seed") == number


@pytest.mark.parametrize(
    ("given", "number"),
    [
        ("9007199254740993", 2**53 + 1),
        ("1e3", 1000),
        ("1E3", 1000),
        ("5.0", 5),
        (5.0, 5),
        (" 7 ", 7),
        ("1_000", 1000),
        ("-3", -3),
    ],
)
def test_whole_numbers_are_ints_however_they_are_written(given, number):
    found = coerce(given, int, "seed")

    assert (found, type(found)) == (number, int)


@pytest.mark.parametrize(
    "given", ["1.5", 1.5, "five", "", "0x10", "inf", "nan", "9" * 5000, True, None, [1]]
)
def test_what_is_no_whole_number_is_refused(given):
    with pytest.raises(ConfigError, match=r"^-s train.seed is .*; expected int$"):
        coerce(given, int, "-s train.seed")


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_float_is_what_was_written(number):
    assert coerce(repr(number), float, "rate") == coerce(number, float, "rate") == number


@pytest.mark.parametrize("given", ["inf", "-inf", "nan", float("inf"), "1e999", "x", True])
def test_what_is_no_number_that_can_be_compared_is_refused(given):
    with pytest.raises(ConfigError, match=r"; expected float$"):
        coerce(given, float, "rate")


@dataclass(frozen=True)
class _Settings:
    word: str = ""
    count: int = 1
    share: float = 0.5
    switch: bool = False

    def __post_init__(self) -> None:
        check_numbers(self, "made", {"share": (0.25, 1), "count": (1, float("inf"))})


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"count": 0}, "made.count is 0; expected 1 or more"),
        ({"share": 0.1}, "made.share is 0.1; expected 0.25 to 1"),
        ({"share": 1.5}, "made.share is 1.5; expected 0.25 to 1"),
    ],
)
def test_numbers_out_of_bounds_are_told_with_the_bounds(values, said):
    with pytest.raises(ConfigError) as refused:
        build(_Settings, values, "-s")

    assert str(refused.value) == said


def test_bounds_of_long_numbers_are_told_in_full():
    @dataclass(frozen=True)
    class Long:
        seed: int

    with pytest.raises(ConfigError, match=r"expected 0 to 9223372036854775807$"):
        check_numbers(Long(2**63), "made", {"seed": (0, 2**63 - 1)})
