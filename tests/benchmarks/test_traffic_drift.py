"""Figures of rollouts beside those of logs, with values that are easy to check."""

import importlib
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def drift(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("traffic_drift")


def side(drift, *scenes, spans=2):
    """One value a scene and span of every figure."""
    made = drift.Side({name: np.zeros((2, spans)) for name in drift.COLUMNS})
    for values in scenes:
        for name in drift.COLUMNS:
            at_s = np.arange(len(values)) * 10.0
            made.add(name, at_s, np.array(values), 10.0)
        made.end_scene()
    return made


def test_figures_are_held_against_the_logs_of_the_same_scenes(drift):
    logs = side(drift, [4.0, 5.0], [8.0, 5.0])
    played = side(drift, [5.0, 5.0], [10.0, 5.0])

    above = drift.beside(logs, played, "ego_mps")

    np.testing.assert_allclose(above.mean, [0.25, 0.0])
    # Each scene alone gives the same, so their resamples do, however far scenes differ.
    np.testing.assert_allclose(above.low, [0.25, 0.0])
    np.testing.assert_allclose(above.high, [0.25, 0.0])


def test_intervals_have_what_scenes_differ_by(drift):
    logs = side(drift, *[[4.0, 4.0]] * 40)
    played = side(drift, *([4.0, 4.0 + number % 2] for number in range(40)))

    above = drift.beside(logs, played, "agents")

    assert above.mean[1] == pytest.approx(0.125)
    assert 0.06 < above.low[1] < 0.11
    assert 0.14 < above.high[1] < 0.19
    assert above.low[0] == above.high[0] == 0


def test_what_logs_do_not_reach_has_no_share(drift):
    logs, played = side(drift, [4.0], [4.0]), side(drift, [4.0, 4.0], [4.0, 4.0])

    above = drift.beside(logs, played, "exits")

    assert above.mean[0] == 0
    assert np.isnan(above.mean[1])
