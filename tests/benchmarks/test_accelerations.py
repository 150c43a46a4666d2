"""Accelerations of vehicles in logs, on scenes that are easily reckoned by hand."""

import importlib
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from infgen.scene import AgentType

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("accelerations")


def agents_at(x_m, agent_type=AgentType.VEHICLE):
    """One agent along the x axis, a place for each token step."""
    pose = torch.zeros((1, len(x_m), 1, 3))
    pose[0, :, 0, 0] = torch.tensor(x_m)
    seen = torch.ones((1, len(x_m), 1), dtype=torch.bool)
    kind = torch.tensor([[int(agent_type)]])
    return SimpleNamespace(pose=pose, observed=seen, visible=seen.clone(), agent_type=kind)


def test_an_acceleration_wants_two_token_steps_before(benchmark):
    # 10, 10, 8 and 2 m/s.
    mps2, counted = benchmark.accelerations(agents_at([0.0, 5.0, 10.0, 14.0, 15.0]))

    assert counted[0, :, 0].tolist() == [False, False, True, True, True]
    torch.testing.assert_close(mps2[0, 2:, 0], torch.tensor([0.0, -4.0, -12.0]))


def test_who_stands_or_is_no_vehicle_is_not_counted(benchmark):
    _, stands = benchmark.accelerations(agents_at([0.0, 0.1, 0.2, 0.3]))
    _, walks = benchmark.accelerations(agents_at([0.0, 5.0, 10.0], AgentType.PEDESTRIAN))

    assert not stands.any()
    assert not walks.any()


def test_who_is_not_seen_before_is_not_counted(benchmark):
    agents = agents_at([0.0, 5.0, 10.0, 15.0, 20.0])
    agents.visible[0, 1] = False

    _, counted = benchmark.accelerations(agents)

    assert counted[0, :, 0].tolist() == [False, False, False, False, True]


def test_bins_and_their_sum_are_in_the_table(benchmark, capsys):
    found = torch.zeros((3, len(benchmark.EDGES_MPS2) + 1)).numpy()
    found[:, 0], found[:, 3] = (2, 8.0, 1.0), (6, 12.0, -3.0)

    rows = benchmark.report(found)

    assert [row["acceleration_mps2"] for row in rows] == ["below -3", "-1 to -0.3", "all"]
    assert [row["nats"] for row in rows] == [4.0, 2.0, 2.5]
    assert [row["faster_mps"] for row in rows] == [0.5, -0.5, -0.25]
    assert "below -3" in capsys.readouterr().out
