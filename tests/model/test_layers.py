"""Attention is what its textbook form says, and tables are the functions they stand for."""

import math

import pytest
import torch
from torch.nn import functional

from infgen.model.layers import (
    Attention,
    FourierEmbedding,
    RelationEmbedding,
    Seen,
    Span,
    gather,
    initialise,
    normed,
)

WIDTH, HEADS = 16, 2


def plain_attention(layer, target, seen):
    """The layer as SPEC 4.1 writes it: keys and values of every pair, one by one."""
    targets, slots, width = target.shape
    split = (layer.heads, width // layer.heads)
    source = layer.norm_target if layer.norm_source is None else layer.norm_source

    def affine(norm, x):
        return x * norm.weight + norm.bias

    x = affine(source, seen.features)
    r = affine(layer.norm_relation, seen.relation)
    key = (layer.key(x) + layer.relation_key(r)).unflatten(-1, split)
    value = (layer.value(x) + layer.relation_value(r)).unflatten(-1, split)
    normal = layer.norm_target(target)
    query = layer.query(normal).unflatten(-1, split)
    score = torch.einsum("nshc,nkhc->nshk", query, key) / math.sqrt(split[1])
    looked = torch.zeros_like(query)
    for n in range(targets):
        for s in range(slots):
            there = seen.present[n, s]
            if there.any():
                weight = score[n, s][:, there].softmax(dim=-1)
                looked[n, s] = torch.einsum("hk,khc->hc", weight, value[n, there])
    looked = looked.flatten(2)
    gate = torch.sigmoid(layer.gate(torch.cat([looked, normal], dim=-1)))
    update = looked + gate * (layer.itself(normal) - looked)
    target = target + layer.norm_out(layer.out(update))
    return target + layer.feed_forward(target)


def make_layer(bipartite):
    torch.manual_seed(1)
    layer = Attention(WIDTH, HEADS, 0.0, bipartite=bipartite)
    for parameter in layer.parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)
    return layer


def make_seen(targets, slots, neighbours):
    torch.manual_seed(2)
    features = normed(torch.randn(targets, neighbours, WIDTH)).requires_grad_()
    relation = normed(torch.randn(targets, neighbours, WIDTH)).requires_grad_()
    present = torch.rand(targets, slots, neighbours) < 0.6
    present[0] = False  # One target sees nobody.
    return Seen(features, relation, present)


@pytest.mark.parametrize("bipartite", [False, True])
@pytest.mark.parametrize("slots", [1, 3])
def test_factorised_attention_is_the_plain_one_and_so_are_its_gradients(bipartite, slots):
    layer, seen = make_layer(bipartite), make_seen(5, slots, 7)
    target = torch.randn(5, slots, WIDTH, requires_grad=True)
    inputs = [target, seen.features, seen.relation, *layer.parameters()]

    found, wanted = layer(target, seen), plain_attention(layer, target, seen)
    pull = torch.randn_like(found)
    gradients = torch.autograd.grad(found, inputs, pull)
    expected = torch.autograd.grad(wanted, inputs, pull)

    torch.testing.assert_close(found, wanted, atol=1e-5, rtol=1e-5)
    for gradient, other in zip(gradients, expected, strict=True):
        torch.testing.assert_close(gradient, other, atol=2e-5, rtol=1e-5)


def test_targets_without_slots_are_targets_with_one():
    layer, seen = make_layer(True), make_seen(5, 1, 7)
    target = torch.randn(5, WIDTH)
    flat = Seen(seen.features, seen.relation, seen.present[:, 0])

    torch.testing.assert_close(layer(target, flat), layer(target[:, None], seen)[:, 0])


def test_a_target_without_neighbours_still_passes_gate_and_feed_forward():
    layer = make_layer(False)
    target = torch.randn(3, WIDTH)
    nobody = torch.zeros(3, 0, WIDTH)

    updated = layer(target, Seen(nobody, nobody, torch.zeros(3, 0, dtype=torch.bool)))

    assert torch.isfinite(updated).all()
    assert (updated - target).abs().max() > 0.1


def test_what_is_not_present_does_not_matter_whatever_it_holds():
    layer, seen = make_layer(False), make_seen(5, 1, 7)
    target = torch.randn(5, 1, WIDTH)
    hidden = ~seen.present[:, 0, :, None]
    other = Seen(
        seen.features.masked_fill(hidden, 3.0),
        seen.relation.masked_fill(hidden, -5.0),
        seen.present,
    )

    assert torch.equal(layer(target, seen), layer(target, other))


def test_dropout_leaves_the_mean_of_what_is_seen():
    torch.manual_seed(0)
    layer = Attention(WIDTH, HEADS, 0.5, bipartite=False).train()
    seen = make_seen(1, 1, 400)
    seen = Seen(seen.features, seen.relation, torch.ones(1, 1, 400, dtype=torch.bool))
    target = torch.randn(1, 1, WIDTH)

    noisy = torch.stack([layer.look(target, seen) for _ in range(100)]).mean(dim=0)

    torch.testing.assert_close(noisy, layer.eval().look(target, seen), atol=0.05, rtol=0.0)


def test_a_width_that_does_not_divide_into_heads_is_refused():
    with pytest.raises(ValueError, match="width 10 does not divide into 4 heads"):
        Attention(10, 4, 0.0, bipartite=False)


def test_parameters_start_as_the_paper_has_them():
    layer = Attention(128, 8, 0.1, bipartite=False)
    layer.apply(initialise)
    embedding = FourierEmbedding(3, 64, 128)
    embedding.apply(initialise)

    assert layer.query.bias.abs().max() == 0
    assert layer.query.weight.abs().max() <= math.sqrt(6 / 256) + 1e-6
    assert float(embedding.frequency.weight.detach().std()) == pytest.approx(0.02, rel=0.2)


@pytest.fixture
def relation():
    torch.manual_seed(3)
    turn = Span(-math.pi, math.pi, 1025, closed=True)
    spans = [Span(0.0, 30.0, 601), turn, Span(-4.0, 0.0, 5)]
    embedding = RelationEmbedding(spans, 8, WIDTH)
    embedding.apply(initialise)
    return embedding.eval()


def exact(relation, values):
    return normed(FourierEmbedding.forward(relation, values))


def test_a_table_is_its_function_but_for_its_kinks(relation):
    values = torch.rand(50, 9, 3) * torch.tensor([30.0, 6.2, 0.0])
    values += torch.tensor([0.0, -3.1, 0.0])
    values[..., 2] = torch.randint(-4, 0, (50, 9)).float()

    found = relation.look_up(values, relation.table())

    gap = (found - exact(relation, values)).abs()
    assert gap.quantile(0.99) < 1e-4  # Elsewhere a ReLU bends between two nodes.
    assert gap.max() < 2e-3


def test_a_table_gives_its_nodes_exactly(relation):
    values = torch.tensor([[[0.0, 0.0, -4.0], [30.0, math.pi / 2, -1.0]]])

    found = relation.look_up(values, relation.table())

    torch.testing.assert_close(found, exact(relation, values), atol=1e-5, rtol=0.0)


def test_rounding_does_not_tell_a_half_turn_left_from_one_right(relation):
    angles = torch.tensor([math.pi - 1e-7, -math.pi + 1e-7])
    values = torch.stack([torch.full((2,), 5.0), angles, torch.full((2,), -1.0)], dim=-1)

    left, right = relation.look_up(values[None], relation.table())[0]

    torch.testing.assert_close(left, right, atol=1e-3, rtol=0.0)


def test_values_beyond_a_table_are_taken_as_its_ends(relation):
    values = torch.tensor([[[31.0, 0.0, -9.0], [30.0, 0.0, -4.0]]])

    beyond, end = relation.look_up(values, relation.table())[0]

    assert torch.equal(beyond, end)


def test_tables_learn(relation):
    values = torch.tensor([[[3.3, 0.3, -2.0]]])

    relation.look_up(values, relation.table()).square()[..., 0].sum().backward()

    assert relation.frequency.weight.grad.abs().sum() > 0
    assert all(p.grad is not None for p in relation.parameters())


def test_gathered_gradients_add_up():
    features = torch.zeros(3, 2, requires_grad=True)

    gather(features, torch.tensor([[0, 0], [0, 2]])).sum().backward()

    assert features.grad.tolist() == [[3, 3], [0, 0], [1, 1]]


def test_normed_features_have_mean_zero_and_variance_one():
    x = normed(torch.randn(4, 64) * 7 + 3)

    torch.testing.assert_close(x.mean(-1), torch.zeros(4), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(x.var(-1, correction=0), torch.ones(4), atol=1e-4, rtol=0.0)
    assert functional.mse_loss(x, x) == 0
