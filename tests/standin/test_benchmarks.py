"""Benchmarks take the path of a GPU on the stand-in device: nothing of it needs CUDA."""

import pytest


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rollout", "training"])
def test_a_row_is_measured_on_a_device(case, name):
    row = case("benchmarks", name)

    assert row["agents"] > 1
    assert row["flops_over_peak"] > 0
    assert all(value >= 0 for value in row.values())


@pytest.mark.slow
def test_rows_about_gpus_are_measured_on_a_device_and_agree_with_a_cpu(case):
    rows = case("gpu_rows")

    assert rows["logits tiny 1 float32"]["holds"]
    assert rows["choices builtin 2 float32"]["holds"]
    assert rows["choices builtin 2 float32"]["same"] == 1.0
    for name in ("rollouts tiny 2 bf16", "training tiny 1 bf16"):
        assert rows[name]["per_s"] > 0
        assert rows[name]["gflop_each"] > 0
