"""Autocast of CUDA for the stand-in device: which operations it casts, and to what.

The lists name the operations of this project that are in CUDA's lists:
https://docs.pytorch.org/docs/stable/amp.html#cuda-ops-that-can-autocast-to-float16
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

_IN_LOW_PRECISION = (
    "linear", "matmul", "mm", "mv", "bmm", "addmm", "addmv", "baddbmm", "addbmm",
    "conv1d", "conv2d", "einsum",
)  # fmt: skip
_IN_FLOAT32 = (
    "exp", "expm1", "log", "log1p", "reciprocal", "rsqrt", "pow.Tensor_Scalar",
    "pow.Tensor_Tensor", "pow.Scalar", "softplus", "layer_norm", "native_layer_norm",
    "logsumexp", "softmax.int", "log_softmax.int", "cumsum", "sum", "sum.dim_IntList",
    "nll_loss", "cross_entropy_loss", "binary_cross_entropy_with_logits", "mse_loss",
    "smooth_l1_loss",
)  # fmt: skip


def autocast_rules(device: str) -> tuple[torch.library.Library, ...]:
    """Cast as CUDA does; every other operation keeps the types it is given.

    Args:
        device: Name of a device of the backend for private use.

    Returns:
        What must be kept for the rules to last.
    """
    rest = torch.library.Library("_", "IMPL")
    rest.fallback(torch.library.fallthrough_kernel, "AutocastPrivateUse1")
    rules = torch.library.Library("aten", "IMPL")
    for name in (*_IN_LOW_PRECISION, *_IN_FLOAT32):
        of, _, overload = name.partition(".")
        operation = getattr(getattr(torch.ops.aten, of), overload or "default")
        done = _cast_first(device, operation, low=name in _IN_LOW_PRECISION)
        rules.impl(name, done, "AutocastPrivateUse1")
    return rest, rules


def _cast_first(device: str, operation: Any, *, low: bool) -> Callable[..., Any]:
    """Do an operation on inputs that are cast; float64 stays what it is."""

    def cast(x: Any) -> Any:
        wants = isinstance(x, Tensor) and x.is_floating_point()
        if not wants or x.dtype == torch.float64:
            return x
        return x.to(torch.get_autocast_dtype(device) if low else torch.float32)

    def done(*args: Any, **kwargs: Any) -> Any:
        args, kwargs = pytree.tree_map(cast, (args, kwargs))
        with torch.autocast(device, enabled=False):
            return operation(*args, **kwargs)

    return done
