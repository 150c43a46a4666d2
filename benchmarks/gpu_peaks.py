"""Operations a second that devices promise, by their names."""

import re
from functools import cache

from measuring import peak_flops

TERA = 1e12
PEAKS = {
    "H100 NVL": (60.0, 418.0, 835.0),
    "H100 PCIe": (51.0, 378.0, 756.0),
    "H100": (67.0, 495.0, 989.0),
    "H200": (67.0, 495.0, 989.0),
    "GH200": (67.0, 495.0, 989.0),
    "A100": (19.5, 156.0, 312.0),
    "A10": (31.2, 62.5, 125.0),
    "L40S": (91.6, 183.0, 362.0),
    "L4": (30.3, 60.0, 121.0),
}
"""TFLOP/s of float32, TF32 and bf16, dense, from NVIDIA's data sheets."""
COLUMN = {"float32": 0, "TF32": 1, "bf16": 2}


def known_peak_flops(name: str, precision: str) -> float | None:
    """Return what the maker of a device promises, if this table has it.

    Args:
        name: As ``torch.cuda.get_device_name`` says.
        precision: ``float32``, ``TF32`` or ``bf16``.
    """
    for model, tflops in PEAKS.items():
        if re.search(rf"\b{model}\b", name):
            return tflops[COLUMN[precision]] * TERA
    return None


@cache
def find_peak(
    name: str, device: str, precision: str, side: int | None = None
) -> tuple[float, str]:
    """Return a device's peak in FLOP/s and where it is from: ``known`` or ``measured``.

    Args:
        name: Of the device.
        device: As PyTorch names it.
        precision: ``float32``, ``TF32`` or ``bf16``.
        side: Of the matrices that are multiplied where the name is not known.
    """
    known = known_peak_flops(name, precision)
    if known is not None:
        return known, "known"
    return peak_flops(device, bf16=precision == "bf16", side=side), "measured"
