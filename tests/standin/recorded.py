"""CUDA graphs on the stand-in device: operations are recorded, and replayed."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode


class RecordedGraph(TorchDispatchMode):
    """Operations in order; nothing is changed by recording them.

    As with a CUDA graph, what Python does between operations is done while they are
    recorded and never again, operations are replayed on the same tensors, and the host can
    neither read nor send anything, nor learn a shape from values.
    """

    def __init__(self) -> None:
        super().__init__()
        self._done: list[tuple[Any, Any, Any, Any]] = []
        self._own: set[int] = set()
        self._before: dict[int, tuple[Tensor, Tensor]] = {}

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        """Do an operation and keep it."""
        kwargs = kwargs or {}
        given = _tensors((args, kwargs))
        written = (each.alias_info for each in func._schema.arguments)
        if any(info is not None and info.is_write for info in written):
            self._keep(given)
        out = func(*args, **kwargs)
        if _waits(func, args) or _crosses(func, given, _tensors(out)):
            raise RuntimeError(f"{func} cannot be captured")
        theirs = {_storage(x) for x in given}
        self._own |= {_storage(x) for x in _tensors(out)} - theirs
        self._done.append((func, args, kwargs, out))
        return out

    def _keep(self, given: list[Tensor]) -> None:
        """Remember tensors that were there before, as they are."""
        for x in given:
            if _storage(x) not in self._own | self._before.keys():
                whole = torch.empty(0, dtype=torch.uint8)
                whole.set_(_value(x).untyped_storage())
                self._before[_storage(x)] = whole, whole.clone()

    def undo(self) -> None:
        """Bring back what was there before."""
        for whole, before in self._before.values():
            whole.copy_(before)

    def replay(self) -> None:
        """Do all of it again."""
        for func, args, kwargs, out in self._done:
            again = _tensors(func(*args, **kwargs))
            for kept, new in zip(_tensors(out), again, strict=True):
                if _value(kept).data_ptr() != _value(new).data_ptr():
                    _value(kept).copy_(_value(new))


def recorder(graphs: list[RecordedGraph]) -> Callable[..., RecordedGraph]:
    """Return what captures as ``cuda_graph`` does, and notes what it has captured."""

    def capture(warm_up: Any, act: Any, beside: Any) -> RecordedGraph:
        warm_up()
        graph = RecordedGraph()
        with graph:
            act()
        graph.undo()
        graphs.append(graph)
        return graph

    return capture


def _tensors(values: Any) -> list[Tensor]:
    return [x for x in pytree.tree_leaves(values) if isinstance(x, Tensor)]


def _value(tensor: Tensor) -> Tensor:
    """The values of a tensor of the stand-in device."""
    value: Tensor = getattr(tensor, "value", tensor)
    return value


def _storage(tensor: Tensor) -> int:
    """Where the values of a tensor and of all its views lie."""
    return _value(tensor).untyped_storage().data_ptr()


def _waits(func: Any, args: Any) -> bool:
    """Whether the host needs values: a number, or how many places a mask has."""
    if torch.Tag.data_dependent_output in func.tags:
        return True
    by_index = func is torch.ops.aten.index.Tensor
    masked = any(x.dtype in (torch.bool, torch.uint8) for x in _tensors(args[1:]))
    return torch.Tag.dynamic_output_shape in func.tags and (masked or not by_index)


def _crosses(func: Any, given: list[Tensor], made: list[Tensor]) -> bool:
    """Whether something comes from, or goes to, the host.

    Single numbers may come as operands, which are arguments of a kernel; not as copies.
    """
    copies = func.overloadpacket in (torch.ops.aten._to_copy, torch.ops.aten.copy_)
    there = {x.device.type for x in given if x.dim() or copies}
    return len(there | {x.device.type for x in made}) > 1
