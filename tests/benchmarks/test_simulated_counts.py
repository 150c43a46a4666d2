"""Numbers of agents in logs and in simulation, on scenes that are easily counted."""

import importlib
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from infgen.tokens.scene_tokens import Presence

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("simulated_counts")


@pytest.fixture
def agents():
    """An ego for nine token steps; another from the fourth, removed at the seventh, 70 m
    away from the sixth on."""
    away = int(Presence.ABSENT)
    there, enters, leaves = Presence.PRESENT, Presence.INSERTED, Presence.REMOVED
    other = [away] * 3 + [int(enters), int(there), int(there), int(leaves)] + [away] * 2
    presence = torch.tensor([[int(enters)] + [int(there)] * 8, other]).mT
    pose = torch.zeros(9, 2, 3)
    pose[5:, 1, 0] = 70.0
    agents = SimpleNamespace(presence=presence, pose=pose, visible=presence != away)
    return SimpleNamespace(**{name: each[None] for name, each in vars(agents).items()})


def test_agents_are_counted_by_quarters_of_the_log(benchmark, agents):
    near, far, inserted, removed, tokens = benchmark.figures(agents, 75.0)

    assert near.tolist() == [2, 4, 3, 2]
    assert far.tolist() == [0, 0, 0, 0]
    assert inserted.tolist() == [0, 1, 0, 0]
    assert removed.tolist() == [0, 0, 1, 0]
    assert tokens.tolist() == [2, 2, 2, 2]


def test_agents_beyond_the_radius_are_counted_apart(benchmark, agents):
    near, far, *_ = benchmark.figures(agents, 60.0)

    assert near.tolist() == [2, 4, 2, 2]
    assert far.tolist() == [0, 0, 1, 0]


def test_the_table_has_means_of_token_steps(benchmark, capsys):
    sums = np.full((5, 2, 4), 8.0)
    sums[:, 1] = 4.0
    sums[-1] = 2.0

    rows = benchmark.report(sums)

    assert [row["quarter 4"] for row in rows] == [4.0, 2.0] * 4
    assert "within the radius" in capsys.readouterr().out
    json.dumps(rows)
