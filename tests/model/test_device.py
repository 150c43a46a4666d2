"""With fewer launches the network says and learns the same."""

from dataclasses import replace

import pytest
import torch

from infgen.config import TrainSettings
from infgen.model.attention.neighbour_attention import Shared
from infgen.model.batching.batch import collate
from infgen.model.batching.tensors import in_float32
from infgen.model.device.attention import _FeedForward, _Look
from infgen.model.device.folding import ALIGNED
from infgen.model.device.index import BatchIndex
from infgen.model.device.together import launched_together
from infgen.model.network import Network
from infgen.model.relation_tables import (
    RelationEmbedding,
    _back_in_segments,
    _back_to_rows,
)
from infgen.model.training.losses import losses, total
from tests.model.conftest import (
    GRID,
    TINY,
    VARIANTS,
    make_motion_codebook,
    make_network,
    make_record,
    make_road_codebook,
)


def learned(network, batch, *, together, bf16=False):
    """Loss and gradients of a batch."""
    network.zero_grad()
    index = BatchIndex.of(batch)
    cast = torch.autocast("cpu", torch.bfloat16, enabled=bf16)
    with cast, launched_together(network, together=together):
        outputs = in_float32(network(batch, hidden_roads=True, index=index))
    loss = total(losses(outputs, batch, TrainSettings()), TrainSettings())
    loss.backward()
    found = {name: p.grad for name, p in network.named_parameters() if p.grad is not None}
    return loss.detach(), found


@pytest.mark.parametrize(
    "variant", ["full", "the paper's", "narrow relations", "smart", "rotary"]
)
def test_launched_together_a_network_learns_what_it_learns_part_by_part(variant, limits):
    torch.manual_seed(1)
    settings = replace(TINY, **VARIANTS[variant])
    network = Network(settings, make_motion_codebook(), make_road_codebook(), GRID)
    batch = collate([make_record(3, agents=12), make_record(4)], limits, 0)

    plain, ours = (learned(network.train(), batch, together=b) for b in (False, True))

    torch.testing.assert_close(ours[0], plain[0], rtol=1e-5, atol=0.0)
    assert ours[1].keys() == plain[1].keys()
    for name, gradient in plain[1].items():
        close = {"rtol": 1e-3, "atol": 1e-4 * float(gradient.abs().max()) + 1e-6}
        torch.testing.assert_close(ours[1][name], gradient, msg=name, **close)


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("variant", VARIANTS)
def test_under_autocast_losses_are_nearly_those_of_float32(variant, together, limits):
    network = make_network(replace(TINY, **VARIANTS[variant])).train()
    batch = collate([make_record(3, agents=12)], limits, 0)
    sharp, _ = learned(network, batch, together=together)

    rough, gradients = learned(network, batch, together=together, bf16=True)

    assert rough != sharp
    torch.testing.assert_close(rough, sharp, rtol=0.02, atol=0.0)
    assert all(torch.isfinite(each).all() for each in gradients.values())


def of_double(*shapes):
    return [torch.randn(*s, dtype=torch.float64, requires_grad=True) for s in shapes]


@pytest.mark.parametrize("share", [0.0, 0.25])
@pytest.mark.parametrize("slots", [1, 2])
@pytest.mark.parametrize("rotary", [False, True])
def test_a_look_is_differentiated_as_it_is_computed(rotary, slots, share):
    torch.manual_seed(2)
    width, related, heads, targets = 6, 4, 3, 3
    each = width // heads
    seen = width + related + ALIGNED
    given = of_double(
        (targets * slots, width), (width, width), (width,), (heads, each, width + related),
        (heads, seen, each), (2 * width, 2 * width), (2 * width,), (4, width),
        (targets, 6, related),
    )  # fmt: skip
    with torch.no_grad():  # As folded: itself, less what is seen; and zeros.
        given[5][width:, :width] = -torch.eye(width)
        given[4][:, width + related + 1 :] = 0
    index = torch.randint(4, (targets, 6))
    hidden = torch.rand(targets, 1, 6) < 0.3
    hidden[1] = True  # Nobody is there.
    cover = torch.zeros(targets, 1, 6, dtype=torch.float64).masked_fill_(hidden, -1e9)
    angle_rad = torch.rand(targets, width // 2, dtype=torch.float64)
    turn = torch.polar(torch.ones_like(angle_rad), angle_rad) if rotary else None

    def look(*given):
        torch.manual_seed(3)  # Drops the same weights each time.
        shared = Shared.of(given[-1])
        more = cover, hidden.all(dim=-1, keepdim=True), share, turn
        shared = shared.values, shared.ticket, shared.pulled
        return _Look.apply(*given[:-1], index, *shared, *more)

    assert torch.autograd.gradcheck(look, given)
    normal, gate, bias = given[0], given[5], given[6]
    opened, own = (normal @ gate[:, width:].T + bias).chunk(2, dim=1)
    blind = slice(slots, 2 * slots)  # Its gate is between nothing and what it is itself.
    found = look(*given)[blind]
    torch.testing.assert_close(found, (opened.sigmoid() * own)[blind])


@pytest.mark.parametrize("share", [0.0, 0.25])
def test_a_feed_forward_is_differentiated_as_it_is_computed(share):
    torch.manual_seed(2)
    given = of_double((5, 3), (12, 3), (12,), (3, 12), (3,))

    def feed_forward(*given):
        torch.manual_seed(3)
        return _FeedForward.apply(*given, share)

    assert torch.autograd.gradcheck(feed_forward, given)
    if not share:
        normal, hidden, hidden_bias, out, out_bias = given
        expected = (normal @ hidden.T + hidden_bias).relu() @ out.T + out_bias
        torch.testing.assert_close(feed_forward(*given), expected)


def test_tables_evaluated_together_are_those_evaluated_alone(network):
    tables = [each for each in network.modules() if isinstance(each, RelationEmbedding)]
    alone = [each.table() for each in tables]

    with launched_together(network, together=True):
        together = [each.table() for each in tables]

    for one, other in zip(together, alone, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)
    assert all(each.evaluated is None for each in tables)


def test_what_comes_back_in_segments_is_what_comes_back_to_rows():
    torch.manual_seed(5)
    pull, nodes = torch.randn(200, 4), torch.randint(30, (200, 6))
    nodes[:150] = 7  # A hot row.
    shares = torch.rand(200, 6)

    found = _back_in_segments(pull, nodes, shares, 40)

    expected = _back_to_rows(pull, nodes, shares, 40)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)
