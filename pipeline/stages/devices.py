"""Devices of rollouts: decided once for all units of a stage, and named in reports.

``plan`` decides the type of device, and it is part of every unit's task and key: units that
were made on a CPU and on a CUDA device never are units of one run. A worker without the
device refuses its unit.
"""

import os
import socket
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from infgen.config import RolloutSettings
from pipeline.engine.stage import FinishedUnit
from pipeline.workers.gpus import DEVICE_SHARE

if TYPE_CHECKING:
    import torch

DRIVERS = ("/dev/nvidiactl", "/dev/dxg", "/dev/kfd", "/dev/nvhost-ctrl")
"""Files of graphics drivers. Without any of them torch, which takes long to import, is not
asked."""
DeviceType = Literal["cpu", "cuda"]
SHARE = 0.9
"""Workers of one device may together allocate so much of its memory; the rest is for what
CUDA itself needs in each of them."""


class DeviceError(ValueError):
    """A device that a unit needs is not there."""


def decide_device(settings: RolloutSettings) -> DeviceType:
    """Return the type of device that rollouts are simulated on: ``cpu`` or ``cuda``."""
    if settings.device != "auto":
        return settings.device
    return "cuda" if any(map(os.path.exists, DRIVERS)) and _has_cuda() else "cpu"


def _has_cuda() -> bool:
    import torch  # noqa: PLC0415

    return torch.cuda.is_available()


def find_device(decided: DeviceType, wanted: str) -> "torch.device":
    """Return this process's device of the type that was decided.

    Args:
        decided: The type of device of all units, ``cpu`` or ``cuda``.
        wanted: As in the settings (``rollout.device``).

    Raises:
        DeviceError: if there is none; or if ``auto`` was decided by a machine without CUDA
            devices, while this one has some, which would be left idle without a word.
    """
    import torch  # noqa: PLC0415

    here, host = _has_cuda(), socket.gethostname()
    if decided == "cuda" and not here:
        raise DeviceError(
            f"{host} has no CUDA device that torch can use, but the units of this run are "
            "simulated on CUDA devices; expected workers that have one, or "
            "rollout.device=cpu"
        )
    if decided == "cpu" and wanted == "auto" and here:
        raise DeviceError(
            f"{host} has a CUDA device, but the machine that planned this run has none, so "
            "rollout.device=auto means cpu; set rollout.device=cuda to use the devices of "
            "the workers, or rollout.device=cpu to leave them idle"
        )
    return torch.device(decided)


def on_device(settings: RolloutSettings, decided: DeviceType) -> RolloutSettings:
    """Return the settings with the type of device that was decided for all units.

    Raises:
        DeviceError: if this process may not use one.
    """
    find_device(decided, settings.device)
    return replace(settings, device=decided)


def device_of_units(units: Sequence[FinishedUnit]) -> str:
    """Return the type of device that all units report.

    Raises:
        DeviceError: if there are several: rollouts of two devices are not alike.
    """
    found = sorted({str(done.report["device"]) for done in units})
    if len(found) > 1:
        raise DeviceError(
            f"units were made on {' and '.join(found)}, expected one type of device; set "
            "rollout.device to one of them"
        )
    return found[0] if found else "none"


def limit_memory(device: "torch.device") -> None:
    """Leave the other workers of a device their part of its memory."""
    import torch  # noqa: PLC0415

    share = DEVICE_SHARE.get()
    if device.type == "cuda" and share < 1:
        torch.cuda.set_per_process_memory_fraction(SHARE * share)


def name_device(device: "torch.device", precision: str) -> str:
    """Name a device and the precision of its matrix products.

    Returns:
        Such as ``NVIDIA H100 80GB HBM3, bf16``, or ``CPU, 1 thread`` for float32.
    """
    import torch  # noqa: PLC0415

    if device.type == "cuda":
        return f"{torch.cuda.get_device_name(device)}, {precision}"
    threads = torch.get_num_threads()
    words = f"{device.type.upper()}, {threads} thread{'s' if threads > 1 else ''}"
    return words if precision == "float32" else f"{words}, {precision}"
