"""Passes of insertion as CUDA graphs: the host launches one thing instead of a thousand.

A graph replays kernels on the tensors that it was captured with. So the state of a token
step is copied into tensors that are kept; a graph reads them, and writes into them what it
has changed. There is one graph for each number of rollouts that a pass is for. Graphs are
captured again when a shape changes, as when rows for more agents are added.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from infgen.rollout.device.running import RunningInsertions, tensors_of, with_tensors


@runtime_checkable
class Graph(Protocol):
    """What was captured."""

    def replay(self) -> None:
        """Do it again, on the same tensors."""


Capture = Callable[[Callable[[], object], Callable[[], object], Graph | None], Graph]
"""Captures what its second argument does, after the first has done the same elsewhere; in
the memory of a graph that is there already."""


def cuda_graph(
    warm_up: Callable[[], object], act: Callable[[], object], beside: Graph | None
) -> Graph:
    """Capture what is done on the current CUDA device, without doing it.

    Args:
        warm_up: Does the same with other tensors, so that all that is done once only
            (workspaces of libraries, numbers that the host keeps) is done before.
        act: What is captured. Never waits, and allocates nothing that outlives it.
        beside: A graph whose memory may be used; the two are never replayed together.

    Raises:
        RuntimeError: if something cannot be captured.
    """
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        warm_up()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    pool = beside.pool() if isinstance(beside, torch.cuda.CUDAGraph) else None
    # Other threads may go on using the device.
    with torch.cuda.graph(graph, pool=pool, capture_error_mode="thread_local"):
        act()
    return graph


@dataclass(frozen=True, slots=True)
class _Captured:
    """A graph, and the tensor that it reads the rollouts of its pass from."""

    graph: Graph
    rollout: Tensor


class PassGraphs:
    """The graphs of a batch's passes, and the state that they work on."""

    def __init__(self, ask: Callable[[RunningInsertions], None], capture: Capture) -> None:
        """Begin without graphs.

        Args:
            ask: Makes a pass: changes a state in place.
            capture: Makes a graph of it.
        """
        self._ask, self._capture = ask, capture
        self._held: RunningInsertions | None = None
        self._captured: dict[int, _Captured] = {}

    def hold(self, running: RunningInsertions) -> RunningInsertions:
        """Return the state of a token step in the tensors that are kept."""
        if self._held is None or _shapes(self._held) != _shapes(running):
            clones = (x.clone() for x in tensors_of(running))
            self._held, self._captured = with_tensors(running, clones), {}
        else:
            _write(self._held, running)
        return replace(self._held)

    def ask(self, running: RunningInsertions) -> None:
        """Make one pass on a state that ``hold`` returned."""
        count = len(running.entries.rollout)
        if count not in self._captured:
            self._captured[count] = self._capture_pass(running)
        captured = self._captured[count]
        captured.rollout.copy_(running.entries.rollout)
        captured.graph.replay()

    def _capture_pass(self, running: RunningInsertions) -> _Captured:
        """Capture a pass for as many rollouts as this one is for."""
        held = self._held
        assert held is not None
        rollout, everyone = running.entries.rollout.clone(), running.entries.all_active

        def asked(tensors: list[Tensor]) -> RunningInsertions:
            state = with_tensors(held, iter(tensors))
            state.entries = replace(state.entries, rollout=rollout, all_active=everyone)
            self._ask(state)
            state.entries = replace(state.entries, rollout=held.entries.rollout)
            return state

        graph = self._capture(
            lambda: asked([x.clone() for x in tensors_of(held)]),
            lambda: _write(held, asked(tensors_of(held))),
            next((each.graph for each in self._captured.values()), None),
        )
        return _Captured(graph, rollout)


def _shapes(running: RunningInsertions) -> tuple[object, ...]:
    """What must be the same for a graph to be replayed."""
    shapes = [(x.shape, x.dtype) for x in tensors_of(running)]
    maps = map(id, tensors_of(running.entries.map, ()))  # Read where they are.
    return *shapes, *maps


def _write(held: RunningInsertions, running: RunningInsertions) -> None:
    """Copy what is not there yet into the tensors that are kept."""
    for kept, new in zip(tensors_of(held), tensors_of(running), strict=True):
        if new is not kept:
            kept.copy_(new)
