"""Computing with one thread, so that results have the same bits on every machine."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute with one thread, as the command line does: sums of more have other bits."""
    import torch  # noqa: PLC0415  # Takes seconds, which opening scenes need not wait for.

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
