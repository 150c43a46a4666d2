"""Attention over padded neighbour lists, with its gradient written out.

Left to autograd, every neighbour's gradient would be made of four products with short inner
dimensions, two of them transposed afterwards; here there are two. Shape letters as in
``layers``, and Q queries of a target (its slots times its heads).
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

HIDDEN_SCORE = -1e9
"""Score of what a target does not see: its weight is exactly zero beside any other."""


class Looked(NamedTuple):
    """What queries saw.

    Attributes:
        features: Neighbours' features summed by weight [N, Q, D].
        relation: Their relations summed by weight [N, Q, D].
        weight: Sum of the weights [N, Q]: 1, but for dropout, or 0 where nobody is seen.
    """

    features: Tensor
    relation: Tensor
    weight: Tensor


def look_at_pairs(
    by_features: Tensor,
    by_relation: Tensor,
    features: Tensor,
    relation: Tensor,
    hidden: Tensor,
    kept: Tensor | None,
) -> Looked:
    """Weigh neighbours by the softmax of their scores, and sum them.

    Args:
        by_features: Queries for features [N, Q, D]; the score is the sum of both products.
        by_relation: Queries for relations [N, Q, D].
        features: Of the neighbours [N, K, D].
        relation: Of the neighbours [N, K, D].
        hidden: Which neighbours there are not [N, Q, K].
        kept: Factor on each weight for dropout [N, Q, K], or None.
    """
    pairs = (by_features, by_relation, features, relation, hidden, kept)
    return Looked(*_Pairs.apply(*pairs))  # type: ignore[no-untyped-call]


class _Pairs(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        by_features: Tensor,
        by_relation: Tensor,
        features: Tensor,
        relation: Tensor,
        hidden: Tensor,
        kept: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        score = torch.bmm(by_features, features.transpose(1, 2))
        score.baddbmm_(by_relation, relation.transpose(1, 2)).masked_fill_(
            hidden, HIDDEN_SCORE
        )
        weight = score.softmax(dim=-1).masked_fill_(hidden, 0.0)
        used = weight if kept is None else weight * kept
        ctx.save_for_backward(by_features, by_relation, features, relation, weight, kept)
        return torch.bmm(used, features), torch.bmm(used, relation), used.sum(dim=-1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulls: Tensor) -> tuple[Tensor | None, ...]:
        by_features, by_relation, features, relation, weight, kept = ctx.saved_tensors
        pull_features, pull_relation, pull_sum = pulls
        pull = torch.bmm(pull_features, features.transpose(1, 2))
        pull.baddbmm_(pull_relation, relation.transpose(1, 2)).add_(pull_sum[..., None])
        used = weight
        if kept is not None:
            used, pull = weight * kept, pull.mul_(kept)
        pull.sub_((pull * weight).sum(dim=-1, keepdim=True)).mul_(
            weight
        )  # Now the score's.

        both = torch.cat([pull, used], dim=1).transpose(1, 2)  # [N, K, 2 Q]
        return (
            torch.bmm(pull, features),
            torch.bmm(pull, relation),
            torch.bmm(both, torch.cat([by_features, pull_features], dim=1)),
            torch.bmm(both, torch.cat([by_relation, pull_relation], dim=1)),
            None,
            None,
        )
