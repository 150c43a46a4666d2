"""Benchmarks take the path of a GPU on the stand-in device: nothing of it needs CUDA."""

import pytest


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rollout", "training"])
def test_a_row_is_measured_on_a_device(case, name):
    row = case("benchmarks", name)

    assert row["agents"] > 1
    assert row["flops_over_peak"] > 0
    assert all(value >= 0 for value in row.values())
