"""Plain values become settings of the right types, exactly or not at all."""

from typing import Annotated, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

import infgen.config
from infgen.errors import ConfigError
from infgen.renamed_settings import RENAMED
from infgen.settings import (
    MAX_SEED,
    NOT_IN_KEY,
    RULES,
    AtLeastOne,
    Bool,
    Float,
    Int,
    Seed,
    build,
    help_texts,
    key_values,
)

SETTINGS = [kind for name, kind in vars(infgen.config).items() if name.endswith("Settings")]


@dataclass(frozen=True, slots=True, config=RULES)
class Example:
    """Made up."""

    word: str = ""
    """Some word,
    or several."""
    whole: Int = 1
    maybe: Int | None = None
    number: Float = 1.0
    count: AtLeastOne = 1
    share: Annotated[Float, Field(ge=0.25, le=1)] = 0.5
    switch: Bool = False
    seed: Seed = 0
    workers: Annotated[Int, NOT_IN_KEY] = 0
    """How many."""

    @model_validator(mode="after")
    def _check(self) -> "Example":
        if self.count == 13:
            raise ValueError("count is 13, an unlucky number")
        return self


def read(**values: Any) -> Example:
    return build(Example, values, "-s made")


@given(st.integers(-(2**80), 2**80))
def test_an_int_keeps_all_its_digits_as_a_number_and_as_a_word(number):
    assert read(whole=number).whole == number
    assert read(whole=str(number)).whole == number
    assert read(maybe=number).maybe == number


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
    found = read(whole=given).whole

    assert (found, type(found)) == (number, int)


@pytest.mark.parametrize(
    "given", ["1.5", 1.5, "five", "", "0x10", "inf", "nan", "9" * 5000, True, None, [1]]
)
def test_what_is_no_whole_number_is_refused(given):
    with pytest.raises(ConfigError, match=r"^-s made.whole is .*; expected "):
        read(whole=given)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_float_is_what_was_written(number):
    assert read(number=repr(number)).number == read(number=number).number == number


@pytest.mark.parametrize("given", ["inf", "-inf", "nan", float("inf"), "1e999", "x", True])
def test_what_is_no_number_that_can_be_compared_is_refused(given):
    with pytest.raises(ConfigError, match=r"^-s made.number is .*; expected "):
        read(number=given)


@pytest.mark.parametrize(
    ("given", "found"), [("true", True), ("False", False), (True, True), (False, False)]
)
def test_a_switch_is_true_or_false(given, found):
    assert read(switch=given).switch is found


@pytest.mark.parametrize("given", ["yes", "on", "1", 1, 0, None, ""])
def test_what_is_neither_true_nor_false_is_refused(given):
    with pytest.raises(ConfigError, match=r"made.switch is .*; expected true or false"):
        read(switch=given)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"count": 0}, "made.count is 0; expected greater than or equal to 1"),
        ({"share": 0.1}, "made.share is 0.1; expected greater than or equal to 0.25"),
        ({"share": "1.5"}, "made.share is '1.5'; expected less than or equal to 1"),
        (
            {"seed": 2**63},
            f"made.seed is {2**63}; expected less than or equal to {MAX_SEED}",
        ),
        ({"count": 13}, "made: count is 13, an unlucky number"),
        ({"cuont": 1}, "made: no setting 'cuont'; did you mean 'count'?"),
    ],
)
def test_what_is_wrong_is_told_in_one_line_with_its_place(values, said):
    with pytest.raises(ConfigError) as refused:
        read(**values)

    assert str(refused.value) == f"-s {said}"


def test_every_value_is_told_with_its_own_place():
    places = {"word": "stages.yaml:1: made", "count": "stages.yaml:2: made"}

    for count, said in (
        (0, "stages.yaml:2: made.count is 0"),
        (13, "stages.yaml:2: made: "),
    ):
        with pytest.raises(ConfigError, match=said):
            build(Example, {"word": "a", "count": count}, places)


def test_an_old_name_is_refused_with_the_new_one():
    with pytest.raises(ConfigError, match="'top_moves'; it is now 'motion_top_k'"):
        build(infgen.config.RolloutSettings, {"top_moves": 1}, "-s rollout")


def test_every_old_name_has_a_new_one_and_is_gone():
    names = {name for kind in SETTINGS for name in kind.__dataclass_fields__}

    assert set(RENAMED.values()) <= names
    assert not names & RENAMED.keys()


def test_a_setting_that_is_not_in_the_key_does_not_change_it():
    assert key_values(Example(workers=3)) == key_values(Example())
    assert key_values(Example(count=3)) != key_values(Example())


def test_the_string_below_a_field_is_its_help_text():
    assert help_texts(Example) == {
        "word": "Some word,\nor several.",
        "workers": "How many.",
    }


@pytest.mark.parametrize("kind", SETTINGS)
def test_every_setting_has_a_help_text_and_a_default_that_is_allowed(kind):
    assert help_texts(kind).keys() == kind.__dataclass_fields__.keys()
    assert build(kind, key_values(kind()), "defaults") == kind()
