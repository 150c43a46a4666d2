"""Devices of rollouts: decided once, refused where they are not, named in reports."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from infgen.config import RolloutSettings
from pipeline.engine.stage import FinishedUnit
from pipeline.stages import devices
from pipeline.stages.devices import (
    DeviceError,
    decide_device,
    device_of_units,
    find_device,
    limit_memory,
    name_device,
    on_device,
)
from pipeline.workers.gpus import DEVICE_SHARE

CPU, CUDA = torch.device("cpu"), torch.device("cuda")


@pytest.fixture
def cuda(monkeypatch, tmp_path):
    """``cuda(there)``: a machine that has a CUDA device, or has none."""

    def have(there):
        monkeypatch.setattr("torch.cuda.is_available", lambda: there)
        monkeypatch.setattr(devices, "DRIVERS", (str(tmp_path),) if there else ())

    return have


@pytest.mark.parametrize(
    ("word", "there", "decided"),
    [
        ("auto", False, "cpu"),
        ("auto", True, "cuda"),
        ("cpu", True, "cpu"),
        ("cuda", False, "cuda"),
    ],
)
def test_the_one_who_plans_decides(cuda, word, there, decided):
    cuda(there)

    assert decide_device(RolloutSettings(device=word)) == decided


def test_without_a_driver_torch_is_not_imported_to_decide():
    code = (
        "import sys; from pipeline.stages import devices; devices.DRIVERS = ('/no/such',)\n"
        "print(devices.decide_device(devices.RolloutSettings()), 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)

    assert done.stdout.split() == ["cpu", "False"], done.stderr


def test_a_worker_without_the_device_refuses(cuda):
    cuda(False)

    with pytest.raises(DeviceError, match=r"has no CUDA device.*rollout.device=cpu"):
        on_device(RolloutSettings(), "cuda")


def test_a_worker_with_a_device_is_not_left_idle_without_a_word(cuda):
    cuda(True)

    with pytest.raises(DeviceError, match=r"auto means cpu; set rollout.device=cuda"):
        on_device(RolloutSettings(), "cpu")
    assert on_device(RolloutSettings(device="cpu"), "cpu").device == "cpu"
    assert find_device("cuda", "auto") == CUDA


def test_what_was_decided_is_part_of_the_settings_that_are_simulated_with(cuda):
    cuda(False)
    settings = RolloutSettings(seconds=4.0)

    assert on_device(settings, "cpu") == dataclasses.replace(settings, device="cpu")


def unit(name, device):
    return FinishedUnit(name, "key", Path(name), {"device": device})


def test_units_of_two_devices_are_no_units_of_one_run():
    assert device_of_units([unit("a", "cuda"), unit("b", "cuda")]) == "cuda"
    with pytest.raises(DeviceError, match="made on cpu and cuda, expected one type"):
        device_of_units([unit("a", "cuda"), unit("b", "cpu")])


def test_a_cpu_is_named_with_its_threads():
    threads = torch.get_num_threads()
    words = f"CPU, {threads} thread" + ("s" if threads > 1 else "")

    assert name_device(CPU, "float32") == words
    assert name_device(CPU, "bf16") == f"{words}, bf16"


def test_a_cuda_device_is_named_by_its_model(monkeypatch):
    monkeypatch.setattr(
        "torch.cuda.get_device_name", lambda device: "NVIDIA H100 80GB HBM3"
    )

    assert name_device(CUDA, "TF32") == "NVIDIA H100 80GB HBM3, TF32"


@pytest.mark.parametrize(
    ("device", "share", "limits"),
    [(CUDA, 1 / 6, [0.15]), (CUDA, 1.0, []), (CPU, 1 / 6, [])],
)
def test_workers_of_one_device_share_its_memory(monkeypatch, device, share, limits):
    found = []
    monkeypatch.setattr("torch.cuda.set_per_process_memory_fraction", found.append)
    before = DEVICE_SHARE.set(share)

    limit_memory(device)

    DEVICE_SHARE.reset(before)
    assert found == pytest.approx(limits)
