"""Insertions and removals by what the ego does, on sums that are easily reckoned."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from infgen.model.latent_rates import Rate, RateProcess

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("ego_standing")


def test_probabilities_are_means_over_latent_rates(benchmark):
    rare, often = torch.tensor([-9.0]), torch.tensor([0.7])
    varies = RateProcess(torch.tensor([-0.5, 0.0]), torch.ones(2), torch.zeros(2))
    never = RateProcess(torch.zeros(2), torch.zeros(2), torch.zeros(2))

    assert benchmark._chance(often, None, Rate.INSERTION) == pytest.approx(0.6682, abs=1e-4)
    # The mean of exp(-0.5 + z) is one; the grid of z ends at 3.2 standard deviations.
    told = benchmark._chance(rare, varies, Rate.INSERTION)
    assert told == pytest.approx(rare.sigmoid(), rel=0.02)
    assert benchmark._chance(rare, never, Rate.REMOVAL) == pytest.approx(rare.sigmoid())


def test_a_token_step_and_an_agent_count_once(benchmark, capsys):
    sums = np.array([[10, 4], [5, 1], [6, 3], [100, 50], [2, 1], [3, 0]], dtype=float)

    drives, stands = benchmark.report(sums)

    assert (drives["inserted"], drives["inserted, expected"]) == (0.5, 0.6)
    assert (drives["removed"], drives["removed, expected"]) == (0.02, 0.03)
    assert (stands["token steps"], stands["inserted, expected"]) == (4, 0.75)
    assert "insertions and removals" in capsys.readouterr().out
    json.dumps([drives, stands])
