"""Biases out of plays: worked out by hand, and as a property."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.metrics.flow import FlowCounts
from pipeline.stages.calibration import Biases
from pipeline.stages.flow_response import BEYOND, DESIGN, FEWEST, Reach, find_best

REACH = Reach(Biases(add=0.1, leave=-0.05), add=0.8, leave=0.4)
TOKENS = 1_000_000
LOGS = FlowCounts(came=TOKENS, went=TOKENS, agents=0, tokens=TOKENS)


def plays(come, go, stay=lambda *_: -99.0):
    """What comes, goes and is at the design, given logarithms of rates as functions."""

    def times(rate):
        return round(TOKENS * math.exp(rate))

    return [
        FlowCounts(times(come(*at)), times(go(*at)), times(stay(*at)), TOKENS)
        for at in DESIGN
    ]


def test_the_bias_that_makes_up_for_what_is_missing_is_found():
    """e^-0.5 of the logs' come, and e times as many a reach on; as many go."""
    best = find_best(plays(lambda a, _: a - 0.5, lambda _, b: b), LOGS, REACH)

    assert best.biases == Biases(add=0.5, leave=-0.05)
    assert (best.came, best.went) == (pytest.approx(1, abs=5e-3), 1)
    assert not best.at_the_end


@given(st.floats(-0.4, 1.4), st.floats(-1.4, 1.4), st.floats(0, 1), st.floats(-0.4, 0.4))
def test_a_known_answer_is_found_again(add, leave, bend, mixed):
    """Wherever it lies in reach, whatever one has to do with the other."""

    def rates(a, b):
        return (a - add) * (1.5 + bend * (a + add)) - mixed * (b - leave)

    def gone(a, b):
        return 0.5 * (a - add) + (b - leave)

    best = find_best(plays(rates, gone), LOGS, REACH)

    assert best.biases.add == pytest.approx(0.1 + 0.8 * add, abs=0.02)
    assert best.biases.leave == pytest.approx(-0.05 + 0.4 * leave, abs=0.02)


def test_what_lies_out_of_reach_is_said_to():
    best = find_best(plays(lambda a, _: a - 5, lambda _, b: b), LOGS, REACH)

    assert best.biases.add == pytest.approx(0.1 + 0.8 * (1 + BEYOND))
    assert best.at_the_end
    assert best.came < 0.1


def test_where_nobody_goes_only_who_comes_decides():
    best = find_best(plays(lambda a, _: a - 0.5, lambda *_: -99.0), LOGS, REACH)

    assert best.biases == Biases(add=0.5, leave=-0.05)
    assert best.went is None


@pytest.mark.parametrize(
    "logs", [FlowCounts(FEWEST - 1, TOKENS, 0, TOKENS), FlowCounts(0, 0, 0, 0)]
)
def test_too_few_newcomers_decide_nothing(logs):
    some = plays(lambda a, _: a, lambda _, b: b)

    assert find_best(some, logs, REACH) is None
    assert find_best([*some[:-1], FlowCounts(0, 9, 0, TOKENS)], LOGS, REACH) is None


def test_who_is_there_weighs_as_much_as_who_comes_and_who_goes():
    """Right rates of both, and e^0.3 times as many: what they disagree about is shared."""
    crowd = FlowCounts(TOKENS, TOKENS, TOKENS, TOKENS)
    some = plays(lambda a, _: a - 0.5, lambda _, b: b, lambda a, _: a - 0.2)

    best = find_best(some, crowd, REACH)

    assert best.biases == Biases(add=0.38, leave=-0.05)  # 0.35 reaches up.
    assert best.came == pytest.approx(math.exp(-0.15), abs=5e-3)
    assert best.agents == pytest.approx(math.exp(0.15), abs=5e-3)
    assert find_best(some, LOGS, REACH).agents is None
