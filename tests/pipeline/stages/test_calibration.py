"""Biases from reliability bins: worked out by hand, and as a property."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.config import RolloutSettings
from pipeline.engine.atomic import StoreError
from pipeline.stages.calibration import (
    LARGEST,
    Biases,
    find_bias,
    read_biases,
    read_found,
    write_found,
)


def bins(count, predicted, happened):
    return {"count": count, "predicted": predicted, "happened": happened}


def test_even_odds_of_what_happens_three_times_in_four_are_shifted_by_log_three():
    assert find_bias(bins([400], [200], [300])) == pytest.approx(math.log(3), abs=1e-4)


def test_what_is_right_is_left_alone():
    assert find_bias(bins([0, 1000, 500], [0, 100, 250], [0, 100, 250])) == 0


@pytest.mark.parametrize(
    "few", [bins([99], [50], [20]), bins([1000], [10], [9]), bins([1000], [990], [991])]
)
def test_too_little_decides_nothing(few):
    assert find_bias(few) == 0


def test_no_bias_is_larger_than_the_largest():
    assert find_bias(bins([10_000], [1], [9_000])) == LARGEST


@given(
    st.lists(st.tuples(st.integers(50, 999), st.floats(0.02, 0.98)), min_size=1),
    st.floats(-2, 2),
)
def test_a_known_shift_is_found_again(groups, shift):
    count, mean = np.array(groups).T
    odds = np.log(mean / (1 - mean)) + shift
    happened = count / (1 + np.exp(-odds))
    if count.sum() < 100 or min(happened.sum(), (count - happened).sum()) < 10:
        return
    found = find_bias(bins(count, count * mean, happened))
    assert found == pytest.approx(shift, abs=1e-3)


def test_the_last_validation_of_the_log_counts(tmp_path):
    first = {"step": 1, "validation": {"add_bins": bins([400], [200], [100])}}
    last = {
        "step": 2,
        "validation": {
            "add_bins": bins([400], [200], [300]),
            "keep_bins": bins([400], [200], [100]),
        },
    }
    lines = [{"step": 1, "motion": 2.0}, first, last, {"step": 2, "validation": {}}]
    (tmp_path / "train.jsonl").write_text("".join(json.dumps(x) + "\n" for x in lines))

    found = read_biases(tmp_path)

    assert found.add == pytest.approx(math.log(3), abs=1e-4)
    assert found.leave == pytest.approx(-math.log(3), abs=1e-4)


def test_weights_without_a_log_are_played_as_they_are(tmp_path):
    assert read_biases(tmp_path) == Biases()


def test_biases_go_on_top_of_those_of_the_settings():
    played = Biases(add=0.5, leave=-0.25).over(RolloutSettings(add_bias=0.25))

    assert (played.add_bias, played.remove_bias) == (0.75, -0.25)


def test_biases_are_read_as_they_were_written(tmp_path):
    write_found(tmp_path, Biases(add=0.1234, leave=-2.0))

    assert read_found(tmp_path) == Biases(add=0.1234, leave=-2.0)


@pytest.mark.parametrize("text", ["", "[]", '{"add": "much"}', '{"keep": 1}'])
def test_a_damaged_file_of_biases_is_named(tmp_path, text):
    (tmp_path / "biases.json").write_text(text)

    with pytest.raises(StoreError, match=r"biases\.json does not hold two biases"):
        read_found(tmp_path)
