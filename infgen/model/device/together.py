"""What blocks and tables of a whole network have in common is launched once for all."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

from torch import nn

from infgen.model.device.attention import folded_together
from infgen.model.device.tables import tables_together
from infgen.model.layers import Attention
from infgen.model.relation_tables import RelationEmbedding


@contextmanager
def launched_together(network: nn.Module, *, together: bool) -> Iterator[None]:
    """Evaluate what depends on weights alone for all of a network at once, for one pass."""
    parts = list(network.modules()) if together else []
    blocks = [part for part in parts if isinstance(part, Attention)]
    tables = [part for part in parts if isinstance(part, RelationEmbedding)]
    folded = folded_together(blocks) if blocks else nullcontext()
    evaluated = tables_together(tables) if tables else nullcontext()
    with folded, evaluated:
        yield
