"""Attention is what its textbook form says, and tables are the functions they stand for."""

import math
from dataclasses import replace

import pytest
import torch
from torch.nn import functional

from infgen.model.attention import parts as attention_parts
from infgen.model.attention.neighbour_attention import Shared
from infgen.model.layers import (
    Attention,
    AttentionSources,
    FourierEmbedding,
    dropout_factors,
    gather,
    initialise,
    normed,
)
from infgen.model.rotary.turns import multiples, turn_of, turned_back
from infgen.model.settings import ModelSettings

WIDTH, HEADS, SOURCES = 16, 2, 9
SETTINGS = ModelSettings(width=WIDTH, heads=HEADS, dropout=0.0)


def plain_attention(layer, target, seen, relation):
    """The layer as SPEC 4.1 writes it: keys and values of every pair, one by one."""
    targets, slots, width = target.shape
    split = (layer.heads, width // layer.heads)
    source = layer.norm_target if layer.norm_source is None else layer.norm_source

    def affine(norm, x):
        return x * norm.weight + norm.bias

    seen_from_here = seen.features[seen.index]
    if seen.turn is not None:
        seen_from_here = turned_back(seen_from_here, seen.turn[:, None])
    x = affine(source, seen_from_here)
    r = affine(layer.norm_relation, relation)
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


def make_layer(bipartite, relation_width=0):
    torch.manual_seed(1)
    settings = replace(SETTINGS, relation_width=relation_width)
    layer = Attention(settings, bipartite=bipartite)
    for parameter in layer.parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)
    return layer


def make_seen(targets, slots, neighbours, relation_width=WIDTH):
    torch.manual_seed(2)
    features = normed(torch.randn(SOURCES, WIDTH)).requires_grad_()
    index = torch.randint(SOURCES, (targets, neighbours))
    relation = normed(torch.randn(targets, neighbours, relation_width)).requires_grad_()
    present = torch.rand(targets, slots, neighbours) < 0.6
    present[0] = False  # One target sees nobody.
    return AttentionSources(features, index, Shared.of(relation), present), relation


@pytest.mark.parametrize("bipartite", [False, True])
@pytest.mark.parametrize("slots", [1, 3])
@pytest.mark.parametrize("relation_width", [WIDTH, 6])
@pytest.mark.parametrize("rotary", [False, True])
def test_factorised_attention_is_the_plain_one_and_so_are_its_gradients(
    bipartite, slots, relation_width, rotary
):
    layer = make_layer(bipartite, relation_width)
    seen, relation = make_seen(5, slots, 7, relation_width)
    if rotary:
        seen = replace(seen, turn=turn_of(torch.randn(5, 3), multiples(WIDTH), 3.0))
    target = torch.randn(5, slots, WIDTH, requires_grad=True)
    inputs = [target, seen.features, relation, *layer.parameters()]

    found = layer(target, seen)
    wanted = plain_attention(layer, target, seen, relation)
    pull = torch.randn_like(found)
    gradients = torch.autograd.grad(found, inputs, pull)
    expected = torch.autograd.grad(wanted, inputs, pull)

    torch.testing.assert_close(found, wanted, atol=1e-5, rtol=1e-5)
    for gradient, other in zip(gradients, expected, strict=True):
        torch.testing.assert_close(gradient, other, atol=2e-5, rtol=1e-5)


def test_targets_taken_a_few_at_a_time_give_what_all_at_once_give(monkeypatch):
    layer, (seen, relation) = make_layer(True), make_seen(5, 2, 7)
    target = torch.randn(5, 2, WIDTH, requires_grad=True)
    inputs = [target, seen.features, relation, *layer.parameters()]

    def run():
        found = layer(target, seen)
        return found, *torch.autograd.grad(found.square().sum(), inputs, retain_graph=True)

    whole = run()
    monkeypatch.setattr(attention_parts, "CACHED_NUMBERS", 2 * 7 * WIDTH)
    parts = run()

    for part, other in zip(parts, whole, strict=True):
        torch.testing.assert_close(part, other, atol=1e-5, rtol=1e-5)


def test_the_gradients_of_all_layers_that_share_relations_add_up():
    first, second = make_layer(True), make_layer(True)
    seen, relation = make_seen(5, 1, 7)
    target = torch.randn(5, 1, WIDTH)

    (both,) = torch.autograd.grad(
        (first(target, seen) + 3 * second(target, seen)).square().sum(), relation
    )
    plain = plain_attention(first, target, seen, relation)
    plain = plain + 3 * plain_attention(second, target, seen, relation)
    (wanted,) = torch.autograd.grad(plain.square().sum(), relation)

    torch.testing.assert_close(both, wanted, atol=1e-3, rtol=1e-4)


def test_targets_without_slots_are_targets_with_one():
    layer, (seen, _) = make_layer(True), make_seen(5, 1, 7)
    target = torch.randn(5, WIDTH)
    flat = replace(seen, present=seen.present[:, 0])

    torch.testing.assert_close(layer(target, flat), layer(target[:, None], seen)[:, 0])


def test_a_target_without_neighbours_still_passes_gate_and_feed_forward():
    layer = make_layer(False)
    target = torch.randn(3, WIDTH)
    nobody = torch.zeros(3, 0, WIDTH)
    none = torch.zeros(3, 0, dtype=torch.bool)

    updated = layer(target, AttentionSources.own(nobody, Shared.of(nobody), none))

    assert torch.isfinite(updated).all()
    assert (updated - target).abs().max() > 0.1


def test_what_is_not_present_does_not_matter_whatever_it_holds():
    layer, (seen, relation) = make_layer(False), make_seen(5, 1, 7)
    target = torch.randn(5, 1, WIDTH)
    hidden = ~seen.present[:, 0, :, None]
    features = seen.features[seen.index].masked_fill(hidden, 3.0)
    other = relation.masked_fill(hidden, -5.0)
    other = AttentionSources.own(features, Shared.of(other), seen.present)

    assert torch.equal(layer(target, seen), layer(target, other))


def test_dropout_leaves_the_mean_of_what_is_seen():
    torch.manual_seed(0)
    layer = Attention(replace(SETTINGS, dropout=0.5), bipartite=False).train()
    seen, _ = make_seen(1, 1, 400)
    seen = replace(seen, present=torch.ones(1, 1, 400, dtype=torch.bool))
    target = torch.randn(1, 1, WIDTH)

    noisy = torch.stack([layer.look(target, seen) for _ in range(100)]).mean(dim=0)

    torch.testing.assert_close(noisy, layer.eval().look(target, seen), atol=0.05, rtol=0.0)


def test_parameters_start_as_the_paper_has_them():
    layer = Attention(ModelSettings(), bipartite=False)
    layer.apply(initialise)
    embedding = FourierEmbedding(3, 64, 128)
    embedding.apply(initialise)

    assert layer.query.bias.abs().max() == 0
    assert layer.query.weight.abs().max() <= math.sqrt(6 / 256) + 1e-6
    assert float(embedding.frequency.weight.detach().std()) == pytest.approx(0.02, rel=0.2)


def test_one_byte_a_place_drops_the_share_asked_for():
    torch.manual_seed(0)

    factors = dropout_factors(torch.empty(1003, 7), 0.1)

    assert factors.unique().tolist() == pytest.approx([0.0, 1 / (1 - 26 / 256)])
    assert float((factors == 0).float().mean()) == pytest.approx(26 / 256, abs=0.01)
    assert float(factors.mean()) == pytest.approx(1, abs=0.01)


def test_gathered_gradients_add_up():
    features = torch.zeros(3, 2, requires_grad=True)

    gather(features, torch.tensor([[0, 0], [0, 2]])).sum().backward()

    assert features.grad.tolist() == [[3, 3], [0, 0], [1, 1]]


def test_normed_features_have_mean_zero_and_variance_one():
    x = normed(torch.randn(4, 64) * 7 + 3)

    torch.testing.assert_close(x.mean(-1), torch.zeros(4), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(x.var(-1, correction=0), torch.ones(4), atol=1e-4, rtol=0.0)
    assert functional.mse_loss(x, x) == 0


@pytest.mark.parametrize("bipartite", [True, False])
def test_evaluation_gives_what_is_given_with_gradients(bipartite):
    layer, (seen, _) = make_layer(bipartite).eval(), make_seen(5, 2, 7)
    target = torch.randn(5, 2, WIDTH)

    with torch.no_grad():
        found = layer(target, seen)

    torch.testing.assert_close(found, layer(target, seen), atol=1e-5, rtol=1e-5)


def test_weights_are_folded_anew_when_they_change():
    layer, (seen, _) = make_layer(True).eval(), make_seen(5, 1, 7)
    target = torch.randn(5, WIDTH)
    other = make_layer(True)
    other.relation_value.weight.data.mul_(2)

    with torch.no_grad():
        before = layer(target, seen)
        layer.load_state_dict(other.state_dict())
        after = layer(target, seen)
        layer.train()
        layer.relation_value.weight.data.div_(2)  # As fused optimizers: no new version.
        back = layer.eval()(target, seen)
        wanted = other.eval()(target, seen)

    torch.testing.assert_close(after, wanted, atol=0, rtol=0)
    assert not torch.equal(before, after)
    torch.testing.assert_close(back, before, atol=0, rtol=0)
