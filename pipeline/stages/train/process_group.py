"""Processes that train together: how they find each other, and sum up.

The first process calls the others together for one piece of work at a time, with a note in
the store that ``torchrun`` provides: what to do, as JSON. Nothing else passes between them
but sums of numbers: of tensors on GPUs by nccl, of tensors on CPUs, as votes are, by gloo.

NCCL only tells its caller of a process that is lost if ``TORCH_NCCL_BLOCKING_WAIT`` is set,
as ``cli.py`` sets it; otherwise a thread of its own ends the process, and nothing is saved.
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed.rendezvous import rendezvous

from pipeline.engine import signals
from pipeline.stages.train.ranks import Rank, own_rank

POLL_S = 0.1
MEETING = timedelta(minutes=30)
"""Time for all processes to start."""
LEAVING_S = 10.0
"""Longest time that the first process waits for the others to leave before it does."""
OVER = "over"
LEFT = "left"


class PeerError(ValueError):
    """Another process of the same run that is gone, or stuck."""


@dataclass(frozen=True, slots=True)
class ProcessGroup:
    """Processes that do the same steps on different scenes. Alone, nothing is to be done.

    Attributes:
        rank: Number of this one.
        size: How many there are.
        device: Where it computes.
    """

    rank: int = 0
    size: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def leads(self) -> bool:
        """Whether this is the process that writes and reports."""
        return self.rank == 0

    def add_up(self, values: Tensor) -> None:
        """Replace values by their sum over all processes.

        Raises:
            PeerError: if another process is gone, or did not come in time.
        """
        if self.size == 1:
            return
        try:
            dist.all_reduce(values)
        except RuntimeError as error:
            why = str(error).splitlines()[0]
            raise PeerError(
                f"process {self.rank} of {self.size} lost another one, which failed, was "
                f"killed, or took longer than train.peer_timeout_s: {why}"
            ) from error

    def any(self, said: bool) -> bool:
        """Tell whether any process says so."""
        votes = torch.tensor(float(said))  # On the CPU: no GPU is waited for.
        self.add_up(votes)
        return bool(votes > 0)

    def check_same(self, number: int, what: str) -> None:
        """Make sure that all processes begin alike.

        Raises:
            PeerError: if they do not.
        """
        found = torch.tensor([number, number**2], dtype=torch.float64)
        self.add_up(found)
        mean, square = (found / self.size).tolist()
        if (mean, square) != (number, number**2):
            raise PeerError(f"process {self.rank} has {what} {number}, others another one")


def own_device() -> torch.device:
    """Where this process computes: its own GPU, if there are any."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return device_of(own_rank(), torch.cuda.device_count())


def device_of(rank: Rank, gpus: int) -> torch.device:
    """Tell which of the GPUs that a process sees is its own.

    Some launchers show every process all GPUs of its machine, some only its own.
    """
    return torch.device("cuda", rank.local % gpus) if gpus else torch.device("cpu")


@dataclass
class _Meeting:
    """The store that all processes share, and how often they were called together."""

    store: Any = None
    calls: int = 0


_MEETING = _Meeting()


@contextmanager
def joined_group() -> Iterator[None]:
    """Meet the other processes; in the end the first one sends them home.

    The store is the first process's and ends with it, so that it leaves last.
    """
    store, rank, size = next(rendezvous("env://", timeout=MEETING))
    _MEETING.store = _part(store, "infgen")
    try:
        yield
    finally:
        # The others may be gone, and the store with them.
        with suppress(RuntimeError):
            if rank == 0:
                _send_home(_MEETING.store, size - 1)
            else:
                _MEETING.store.add(LEFT, 1)


def _send_home(store: Any, others: int) -> None:
    """Tell the others that there is no more to do, and wait until they have left."""
    store.set(OVER, "")
    deadline = time.monotonic() + LEAVING_S
    while store.add(LEFT, 0) < others and time.monotonic() < deadline:
        time.sleep(POLL_S)


@contextmanager
def form_group(work: Mapping[str, Any], timeout_s: float) -> Iterator[ProcessGroup]:
    """Form a team for one piece of work, if there are others; for the first process.

    Args:
        work: What the others need to know: JSON-able.
        timeout_s: Longest wait for one of them.
    """
    if _MEETING.store is None:
        yield ProcessGroup(device=own_device())
        return
    call = {"work": work, "timeout_s": timeout_s}
    _MEETING.store.set(str(_MEETING.calls), json.dumps(call))
    with _process_group(timeout_s) as group:
        yield group


def follow(take_part: Callable[[Mapping[str, Any], ProcessGroup], None]) -> None:
    """Take part in whatever the first process calls for, until it is done.

    Args:
        take_part: Does one piece of work with the others.

    Raises:
        PeerError: if the first process is gone.
        Stopped: if the run is stopped.
    """
    with signals.handling_signals():
        while (call := _next_call()) is not None:
            with signals.deferred(), _process_group(call["timeout_s"]) as group:
                take_part(call["work"], group)


def _next_call() -> dict[str, Any] | None:
    """Wait for the next piece of work; None if there is no more."""
    store, key = _MEETING.store, str(_MEETING.calls)
    if store is None:
        return None
    try:
        while not store.check([key]):
            if store.check([OVER]):
                return None
            time.sleep(POLL_S)
        call: dict[str, Any] = json.loads(store.get(key))
    except RuntimeError as error:
        raise PeerError(f"the first process is gone: {error}") from error
    return call


@contextmanager
def _process_group(timeout_s: float) -> Iterator[ProcessGroup]:
    rank, device = own_rank(), own_device()
    if _MEETING.store is None:
        raise PeerError("this process has not joined a group")
    store = _part(_MEETING.store, f"call-{_MEETING.calls}")
    _MEETING.calls += 1
    on_gpu = device.type == "cuda"
    if on_gpu:
        torch.cuda.set_device(device)
    try:
        dist.init_process_group(
            "cpu:gloo,cuda:nccl" if on_gpu else "gloo",
            device_id=device if on_gpu else None,
            store=store,
            rank=rank.number,
            world_size=rank.count,
            timeout=timedelta(seconds=timeout_s),
        )
    except RuntimeError as error:
        raise PeerError(f"process {rank.number} waited in vain: {error}") from error
    try:
        yield ProcessGroup(rank.number, rank.count, device)
    finally:
        dist.destroy_process_group()


def _part(store: Any, name: str) -> Any:
    """Keep what is written under one name apart from the rest of a store."""
    return dist.PrefixStore(name, store)  # type: ignore[attr-defined]
