"""How long vehicles creep, of cars whose speeds are known."""

import importlib

import pytest

from tests.benchmarks.test_contacts import BENCHMARKS, traffic


@pytest.fixture
def creeping(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("creeping")


def measured(creeping, *cars):
    side = creeping.Side()
    creeping.take(side, traffic(*cars))
    return side


def test_speeds_are_counted_every_half_second_after_now(creeping):
    side = measured(creeping, (0, 0, 0, 10, 0), (0, 20, 0, 1, 0), (0, 40, 0, 0, 0))

    found = creeping.report(side, side)["rollouts"]

    assert [found[how] for how in creeping.HOW] == [pytest.approx(1 / 3)] * 3
    assert found["moving_mps"] == pytest.approx(5.5, abs=0.01)


@pytest.mark.parametrize(
    ("other", "behind"),
    [
        ((15, 0, 0, 0, 0), True),  # 3 s after now, 11 m ahead of the one that creeps
        ((15, 2.5, 0, 0, 0), False),
        ((30, 0, 0, 0, 0), False),
        ((-5, 0, 0, 0, 0), False),
    ],
)
def test_who_creeps_for_four_seconds_is_told_with_whom_it_follows(creeping, other, behind):
    # 1 m/s all the time; what is before now does not count.
    side = measured(creeping, (0, 0, 0, 1, 0), other)

    (told,) = side.runs
    assert told[0] == behind
    assert creeping.report(side, side)["logs"]["runs"]["of each"] == 1


def test_who_creeps_for_less_is_not_told(creeping):
    assert not measured(creeping, (0, 0, 0, 1, 22)).runs
    assert measured(creeping, (0, 0, 0, 1, 19)).runs
