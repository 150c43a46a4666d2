"""Speeds that are expected, on distributions that are easily reckoned by hand."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("expected_speeds")


def test_a_motion_token_has_the_mean_speed_of_half_a_second(benchmark):
    end_pose = torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 0.1], [-1.0, 0.0, 0.0]])

    found = benchmark._speed_mps(end_pose)

    assert found.tolist() == [0.0, 10.0, -2.0]


def test_speeds_are_means_of_token_steps_and_empty_rows_are_zero(benchmark, capsys):
    sums = np.zeros((6, 2, 7))
    sums[:, 1, 6] = 4, 64, 66, 60, 16, 9

    rows = benchmark.report(sums)

    fast = rows[-1]
    assert (fast["who"], fast["m/s"], fast["token steps"]) == ("the ego", "14 and more", 4)
    assert [fast[name] for name in benchmark.COLUMNS] == [16.0, 16.5, 15.0, 2.0, 1.5]
    assert rows[0]["token steps"] == 0
    assert rows[0]["now"] == 0.0
    assert len(rows) == 14
    assert "speeds of vehicles" in capsys.readouterr().out
    json.dumps(rows)
