"""``benchmarks/gpu.py``: every path of it but CUDA's, and how it keeps to its time."""

import importlib
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def load(monkeypatch):
    """``load(name)``: a module of the benchmarks, which import each other by name."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module


def run(*words):
    done = subprocess.run(
        [sys.executable, "-W", "ignore", str(BENCHMARKS / "gpu.py"), *words],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout, json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_the_small_case_measures_every_kind_of_row_on_a_cpu():
    text, figures = run("--device", "cpu", "--small")

    assert figures["not_measured"] == []
    rows = figures["rows"]
    assert {name.split()[0] for name in rows} == {
        "logits", "choices", "rollouts", "graphs", "training", "kernels",
    }  # fmt: skip
    assert rows["logits tiny 1 float32"] == {"largest_gap": 0.0, "holds": True}
    assert rows["choices builtin 4 float32"]["same"] == 1.0
    assert rows["choices builtin 4 bf16"]["same"] > 0.9
    assert rows["choices builtin 4 bf16"]["largest_gap"] > 0
    assert rows["graphs tiny 1 auto"]["same"] == 1.0
    for name in ("rollouts tiny 1 bf16", "graphs tiny 1 auto", "training tiny 1 float32"):
        row = rows[name]
        assert row["per_s"] > 0
        assert 0 < row["of_peak"] < 1
        assert row["peak"] == "measured"
    dearest = rows["kernels tiny 1 auto"]["training"]
    assert len(dearest) == 10
    assert [ms for _, ms, _ in dearest] == sorted(
        (ms for _, ms, _ in dearest), reverse=True
    )
    assert "scenes (training) and rollouts of 30 s, a second" in text


def test_rows_that_there_is_no_time_for_are_not_run():
    text, figures = run("--device", "cpu", "--minutes", "0")

    assert figures["not_measured"] == list(figures["rows"])
    assert "training paper 1024 bf16" in figures["not_measured"]
    assert {row["failed"] for row in figures["rows"].values()} == {"not run"}
    assert "dearest kernels of a step, paper, batch 32: not run" in text


@pytest.mark.slow
def test_a_row_that_fails_is_named_and_the_rest_goes_on(load):
    gpu, rows = load("gpu"), load("gpu_rows")
    place = rows.Place("cpu", 1, 0.1, small=True)
    bad = rows.Row("training", "no such size", 1, "float32")
    good = rows.Row("logits", "tiny", 1, "float32")

    found = gpu._measure_group([bad, good], place, time.monotonic() + 100.0)

    assert found[bad.name] == {"failed": "KeyError: 'no such size'"}
    assert found[good.name]["holds"]


def test_a_row_for_which_memory_is_too_small_says_so(load, monkeypatch, capsys):
    gpu, rows = load("gpu"), load("gpu_rows")
    place = rows.Place("cpu", 1, 0.1, small=True)
    row = rows.Row("training", "paper", 1024, "float32")

    def measure(row, place):
        raise gpu.torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(gpu, "measure", measure)
    gpu.work_on([row], place, time.monotonic())

    begun, found = map(json.loads, capsys.readouterr().out.splitlines())
    assert begun == {"begun": row.name}
    assert found == {"name": row.name, "failed": "out of memory"}


def test_a_process_that_takes_too_long_is_ended(load, monkeypatch):
    gpu, rows = load("gpu"), load("gpu_rows")
    monkeypatch.setattr(gpu, "GRACE_S", 0.0)
    place = rows.Place("cpu", 1, 0.1, small=True)
    row = rows.Row("logits", "tiny", 1, "float32")

    found = gpu._measure_group([row], place, time.monotonic() + 0.1)

    assert found == {row.name: {"failed": "not run: it took too long"}}


def test_a_group_gets_its_share_of_the_time_that_is_left(load):
    budget = load("gpu").Budget(time.monotonic() + 400.0, [1.0, 2.0, 1.0])

    assert budget.next_s() == pytest.approx(100.0, abs=1.0)
    assert budget.next_s() == pytest.approx(400.0 * 2 / 3, abs=1.0)
    assert budget.next_s() == pytest.approx(400.0, abs=1.0)


@pytest.mark.parametrize(
    ("name", "precision", "tera"),
    [
        ("NVIDIA H100 80GB HBM3", "bf16", 989.0),
        ("NVIDIA H100 PCIe", "TF32", 378.0),
        ("NVIDIA H100 NVL", "float32", 60.0),
        ("NVIDIA H200", "TF32", 495.0),
        ("NVIDIA A100-SXM4-80GB", "float32", 19.5),
        ("NVIDIA A10", "bf16", 125.0),
        ("NVIDIA L4", "float32", 30.3),
        ("NVIDIA L40S", "float32", 91.6),
    ],
)
def test_peaks_are_known_by_name(load, name, precision, tera):
    peaks = load("gpu_peaks")

    assert peaks.known_peak_flops(name, precision) == tera * 1e12


@pytest.mark.parametrize("name", ["NVIDIA GeForce RTX 4090", "CPU, 1 thread", "Tesla L400"])
def test_other_peaks_are_measured(load, name):
    peaks = load("gpu_peaks")

    assert peaks.known_peak_flops(name, "bf16") is None
    assert peaks.find_peak(name, "cpu", "float32", 64)[1] == "measured"
