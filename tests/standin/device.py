"""A stand-in for a GPU: an accelerator that computes true values on the CPU.

It is a device of its own type (``standin:0``), so everything takes the path that it takes
on a GPU, and what fails there fails here: operations that mix devices are refused with the
line of the project that asked for them. Kernels and host waits are counted by line. There
is no speed to be measured, only how often a GPU would be launched and waited for.

It needs a process of its own: ``set_up`` comes before ``infgen`` is imported.
"""

import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._mode_utils import no_dispatch
from torch.utils._python_dispatch import TorchDispatchMode

from tests.standin.autocast import autocast_rules

NAME = "standin"
ROOT = Path(__file__).parents[2]
_OWN = str(Path(__file__))
_PROJECT = tuple(str(ROOT / part) for part in ("infgen", "pipeline", "benchmarks"))

_aten = torch.ops.aten
_FREE = {
    "view", "_unsafe_view", "reshape", "expand", "permute", "transpose", "t", "select",
    "slice", "squeeze", "unsqueeze", "unbind", "split", "split_with_sizes", "chunk",
    "detach", "alias", "as_strided", "unfold", "diagonal", "empty", "empty_like",
    "empty_strided", "new_empty", "new_empty_strided", "lift_fresh", "_reshape_alias",
    "movedim", "narrow", "view_as_real", "view_as_complex", "set_", "is_same_size",
    "_has_compatible_shallow_copy_type", "resize_", "numel", "size", "stride",
    "storage_offset", "sym_size", "sym_stride", "sym_numel", "sym_storage_offset",
    "is_pinned", "unflatten", "view_as", "expand_as", "flatten", "ravel",
}  # fmt: skip
"""Operations that launch nothing."""
_WAITING = {
    "_local_scalar_dense", "item", "nonzero", "masked_select", "unique", "_unique2",
    "unique_consecutive", "unique_dim", "is_nonzero", "equal", "_linalg_check_errors",
    "bincount",
}  # fmt: skip
"""Operations whose result the host needs before it can go on."""
_OF_THE_HOST = {"_local_scalar_dense", "equal", "is_nonzero", "item"}
"""Operations whose result is no tensor."""
_OF_ONE_TYPE = {"native_layer_norm", "native_layer_norm_backward"}
"""Operations that refuse mixed types on CUDA, and not on a CPU."""
_RESHAPING = {"squeeze_", "unsqueeze_", "t_", "transpose_", "swapaxes_", "as_strided_"}
"""Operations that change a shape in place."""


@dataclass
class Tally:
    """How often a GPU would be launched, and waited for, by line of the project."""

    kernels: Counter[str] = field(default_factory=Counter)
    waits: Counter[str] = field(default_factory=Counter)
    copies: Counter[str] = field(default_factory=Counter)

    def words(self, most: int = 12) -> str:
        """The dearest lines, for people."""
        parts = []
        for name in ("kernels", "waits", "copies"):
            counts: Counter[str] = getattr(self, name)
            parts.append(f"{name}: {sum(counts.values())}")
            parts += [f"  {count:6d} {line}" for line, count in counts.most_common(most)]
        return "\n".join(parts)


class MixedDevicesError(RuntimeError):
    """One operation asked for tensors of two devices."""


class MixedTypesError(RuntimeError):
    """An operation got inputs and parameters of two data types."""


class StandInTensor(Tensor):
    """A tensor that says it is on the stand-in device, and holds its values on the CPU."""

    value: Tensor

    @staticmethod
    def __new__(cls, value: Tensor) -> "StandInTensor":
        made = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            value.size(),
            strides=value.stride(),
            storage_offset=value.storage_offset(),
            dtype=value.dtype,
            device=torch.device(NAME, 0),
            requires_grad=False,
        )
        made.value = value
        return made

    def __getitem__(self, index: Any) -> Tensor:
        return super().__getitem__(_indices(index))

    def __setitem__(self, index: Any, values: Any) -> None:
        super().__setitem__(_indices(index), values)

    def __repr__(self, **_: Any) -> str:
        return f"StandIn({self.value!r})"

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _run(func, args, kwargs or {})


def _indices(index: Any) -> Any:
    """Make tensors of lists: PyTorch would make them behind the mode."""
    if isinstance(index, tuple):
        return tuple(torch.tensor(x) if isinstance(x, list) else x for x in index)
    return torch.tensor(index) if isinstance(index, list) else index


class StandIn(TorchDispatchMode):
    """While active, tensors may be made on the stand-in device."""

    tally: Tally | None = None

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _run(func, args, kwargs or {})


@dataclass
class _State:
    tally: Tally = field(default_factory=Tally)
    libraries: tuple[Any, ...] = ()


_STATE = _State()


@contextmanager
def counted() -> Iterator[Tally]:
    """Count what happens from here on."""
    before, _STATE.tally = _STATE.tally, Tally()
    try:
        yield _STATE.tally
    finally:
        _STATE.tally = before


def _is_ours(device: Any) -> bool:
    return device is not None and torch.device(device).type == NAME


def _name(func: Any) -> str:
    return func._schema.name.split("::")[1]


def _line() -> str:
    """The innermost line of the project that led here."""
    frame = sys._getframe(1)
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(_PROJECT):
            return f"{Path(name).relative_to(ROOT)}:{frame.f_lineno}"
        frame = frame.f_back
    return "autograd" if torch._C._current_graph_task_id() >= 0 else "outside the project"


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Do an operation on the CPU as the stand-in device would, or refuse it."""
    if func._can_decompose() and torch._C._dispatch_has_kernel_for_dispatch_key(
        func.name(), "CompositeImplicitAutograd"
    ):
        found = func.decompose(*args, **kwargs)
        if found is not NotImplemented:
            return found
    tensors = [x for x in pytree.tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
    ours = [x for x in tensors if isinstance(x, StandInTensor)]
    name = _name(func)
    if name == "_to_copy":
        return _to_copy(func, args, kwargs, ours)
    if name == "copy_":
        return _copy(args)
    if not ours and not _is_ours(kwargs.get("device")):
        return func(*args, **kwargs)
    if ours:
        _check_devices(func, name, tensors)
    if name in _OF_ONE_TYPE:
        _check_types(func, tensors)
    _count(name, args)
    return (
        _reshape(func, args, kwargs) if name in _RESHAPING else _compute(func, args, kwargs)
    )


def _compute(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Do an operation on the values; wrap what it returns."""
    wanted = kwargs.get("device")
    if wanted is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    plain_args, plain = pytree.tree_map(_unwrap, (args, kwargs))
    found = func(*plain_args, **plain)
    if _name(func) in _OF_THE_HOST or (wanted is not None and not _is_ours(wanted)):
        return found
    written = _written(func, args, kwargs)
    return pytree.tree_map(
        lambda x: _wrap(x, written) if isinstance(x, Tensor) else x, found
    )


def _reshape(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Change a shape in place: that of the values, and that of the tensor."""
    func(_unwrap(args[0]), *args[1:], **kwargs)
    with no_dispatch():
        before = torch._C._meta_in_tls_dispatch_include()
        torch._C._set_meta_in_tls_dispatch_include(True)
        try:
            func(*args, **kwargs)
        finally:
            torch._C._set_meta_in_tls_dispatch_include(before)
    return args[0]


def _unwrap(x: Any) -> Any:
    return x.value if isinstance(x, StandInTensor) else x


def _wrap(value: Tensor, written: list[StandInTensor]) -> Tensor:
    """Wrap a result; what an operation wrote in place is the tensor that was given."""
    for given in written:
        if given.value is value:
            return given
    return StandInTensor(value)


def _written(func: Any, args: Any, kwargs: Any) -> list[StandInTensor]:
    found = []
    for place, argument in enumerate(func._schema.arguments):
        alias = argument.alias_info
        if alias is None or not alias.is_write:
            continue
        value = kwargs.get(argument.name, args[place] if place < len(args) else None)
        found += [x for x in pytree.tree_leaves(value) if isinstance(x, StandInTensor)]
    return found


def _check_devices(func: Any, name: str, tensors: list[Tensor]) -> None:
    """Refuse tensors of the CPU, but single numbers, and indices, which are copied."""
    strange = [x for x in tensors if not isinstance(x, StandInTensor) and x.dim() > 0]
    if not strange:
        return
    if name in ("index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index"):
        _STATE.tally.waits[_line()] += len(strange)  # Copied to the device, and waited for.
        return
    where = "".join(traceback.format_stack(limit=25)[:-3])
    sizes = ", ".join(f"{tuple(x.shape)} on {x.device}" for x in tensors)
    raise MixedDevicesError(f"{func} at {_line()} got {sizes}\n{where}")


def _check_types(func: Any, tensors: list[Tensor]) -> None:
    """Refuse floating-point tensors of two types, statistics in float32 aside."""
    kinds = given = [x.dtype for x in tensors if x.is_floating_point()]
    if _name(func) == "native_layer_norm_backward":
        given = kinds[:2] + kinds[4:]  # The mean and the spread are float32.
    if len(set(given)) > 1:
        raise MixedTypesError(f"{func} at {_line()} got {given}")


def _to_copy(func: Any, args: Any, kwargs: dict[str, Any], ours: list[Any]) -> Any:
    wanted = kwargs.get("device")
    source = bool(ours)
    target = source if wanted is None else _is_ours(wanted)
    value = _unwrap(args[0])
    plain = {name: each for name, each in kwargs.items() if name != "device"}
    if source != target:
        blocking = not (kwargs.get("non_blocking") and (source or _is_pinned(value)))
        if not (source or target) or blocking:
            _STATE.tally.waits[_line()] += 1
        _STATE.tally.copies[_line()] += 1
        plain.pop("non_blocking", None)
        plain.pop("pin_memory", None)
    elif source:
        _count("_to_copy", args)
    found = func(value, **plain)
    return StandInTensor(found) if target else found


def _copy(args: Any) -> Any:
    target, source = args[0], args[1]
    if isinstance(target, StandInTensor) != isinstance(source, StandInTensor):
        _STATE.tally.waits[_line()] += 1
        _STATE.tally.copies[_line()] += 1
    elif isinstance(target, StandInTensor):
        _count("copy_", args)
    _unwrap(target).copy_(_unwrap(source))
    return target


def _count(name: str, args: Any) -> None:
    if name in _FREE:
        return
    line = _line()
    _STATE.tally.kernels[line] += 1
    if name in _WAITING:
        _STATE.tally.waits[line] += 1
    if name in ("index", "index_put", "index_put_", "_index_put_impl_"):
        masks = [
            x for x in args[1] if x is not None and x.dtype in (torch.bool, torch.uint8)
        ]
        _STATE.tally.waits[line] += len(masks)  # A mask becomes indices: how many?
    if name == "repeat_interleave":
        _STATE.tally.waits[line] += 1


class _Module:
    """What PyTorch asks a backend for."""

    def is_available(self) -> bool:
        return True

    def is_initialized(self) -> bool:
        return True

    def _is_in_bad_fork(self) -> bool:
        return False

    def current_device(self) -> int:
        return 0

    def device_count(self) -> int:
        return 1

    def manual_seed_all(self, seed: int) -> None:
        pass

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.float32, torch.bfloat16, torch.float16]

    def synchronize(self, device: Any = None) -> None:
        pass

    def max_memory_allocated(self, device: Any = None) -> int:
        return 0  # It has no memory of its own.


def set_up() -> torch.device:
    """Register the device; to be called before ``infgen`` is imported."""
    from torch.utils.backend_registration import (  # noqa: PLC0415
        _setup_privateuseone_for_python_backend,
    )

    if "infgen" in sys.modules:
        raise RuntimeError("infgen is imported already; set the stand-in device up first")
    _setup_privateuseone_for_python_backend(NAME, backend_module=_Module())
    _STATE.libraries = autocast_rules(NAME)
    # Wrappers cannot be inference tensors.
    torch.inference_mode = lambda *_: torch.no_grad()  # type: ignore[misc, assignment]
    torch.tensor = _made(torch.tensor)
    torch.as_tensor = _made(torch.as_tensor)
    Tensor.new_tensor = _new_tensor  # type: ignore[method-assign]
    Tensor.numpy = _numpy(Tensor.numpy)  # type: ignore[method-assign]
    Tensor.pin_memory = _pin_memory  # type: ignore[method-assign]
    Tensor.tolist = _tolist(Tensor.tolist)  # type: ignore[method-assign]
    return torch.device(NAME, 0)


def _made(make: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """A constructor that copies behind modes, on the CPU first, then to the device."""

    def constructor(data: Any, *, device: Any = None, **more: Any) -> Tensor:
        if _is_ours(device):
            return make(data, **more).to(device)
        return make(data, device=device, **more)

    return constructor


def _new_tensor(
    self: Tensor, data: Any, *, dtype: Any = None, device: Any = None
) -> Tensor:
    return torch.tensor(data, dtype=dtype or self.dtype, device=device or self.device)


def _numpy(plain: Callable[..., Any]) -> Callable[..., Any]:
    def numpy(self: Tensor, *, force: bool = False) -> Any:
        if isinstance(self, StandInTensor):
            if not force:
                raise TypeError(
                    f"numpy() of a tensor on {self.device}; expected .cpu() first"
                )
            return plain(self.detach().cpu())
        return plain(self, force=force)

    return numpy


def _pin_memory(self: Tensor) -> Tensor:
    """Return a tensor from which copies to the device need no waiting."""
    pinned = self.clone()
    pinned.pinned = True  # type: ignore[attr-defined]
    return pinned


def _is_pinned(value: Tensor) -> bool:
    return getattr(value, "pinned", False)


def _tolist(plain: Callable[..., Any]) -> Callable[..., Any]:
    def tolist(self: Tensor) -> Any:
        return plain(self.detach().cpu() if isinstance(self, StandInTensor) else self)

    return tolist
