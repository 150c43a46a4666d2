"""One look of a query at what is around it."""

from torch import Tensor, nn

from infgen.model.layers import Attention, AttentionSources
from infgen.model.settings import ModelSettings


class QueryBlock(nn.Module):
    """One look at the roads and at the agents around a query."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.roads = Attention(settings, bipartite=True)
        self.agents = Attention(settings, bipartite=True)

    def forward(
        self, x: Tensor, roads: AttentionSources, agents: AttentionSources
    ) -> Tensor:
        """Update queries [N, D], or [N, S, D]."""
        updated: Tensor = self.agents(self.roads(x, roads), agents)
        return updated
