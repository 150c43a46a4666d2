"""What the ego does, for insertion and removal.

Where the ego stands, a third as many agents come into sight as where it drives, and
other ones: ahead of an ego that drives come those that are slower. The query of insertion
looks at the ego as at one of many agents around, and a removal at where an agent is to the
ego. So both are told what the ego is and did last, and for how long it has stood, by its
own embedding.
"""

from jaxtyping import Float
from torch import Tensor, nn

from infgen.model.layers import begin_last_at_zero, mlp


class EgoFeatures(nn.Module):
    """What is added to those who have to know what the ego does."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.embed = mlp(width, width, width)

    def begin_at_zero(self) -> None:
        """Let the features be zero at first."""
        begin_last_at_zero(self.embed)

    def forward(self, embedded: Float[Tensor, "ego width"]) -> Float[Tensor, "ego width"]:
        """Describe egos by their normed embeddings."""
        told: Tensor = self.embed(embedded)
        return told
