"""Tables are the functions they stand for, and learn as those would."""

import math

import pytest
import torch

from infgen.model import relation_tables
from infgen.model.layers import FourierEmbedding, initialise, normed
from infgen.model.relation_tables import RelationEmbedding, Span

WIDTH = 16


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


def test_pairs_embedded_in_parts_are_those_embedded_at_once(relation, monkeypatch):
    values = torch.rand(11, 3, 3) * torch.tensor([30.0, 3.0, -4.0])
    parameters = list(relation.parameters())

    def run():
        found = relation.look_up(values, relation.table())
        return found, *torch.autograd.grad(found[..., :5].square().sum(), parameters)

    whole = run()
    monkeypatch.setattr(relation_tables, "CACHED_NUMBERS", 4 * WIDTH)
    for part, other in zip(run(), whole, strict=True):
        torch.testing.assert_close(part, other, atol=1e-4, rtol=1e-4)


def test_gradients_of_tables_are_those_of_the_plain_sum(relation):
    torch.manual_seed(5)
    values = torch.rand(40, 3, 3) * torch.tensor([30.0, 3.0, -4.0])
    parameters = list(relation.parameters())
    for parameter in parameters:
        parameter.data += 0.1 * torch.randn_like(parameter)
    table = relation.table()

    def plain():
        nodes, shares = relation._places(values.flatten(0, 1))
        return normed(relation.out((table[nodes] * shares[..., None]).sum(dim=1)))

    found = relation.look_up(values, table).flatten(0, 1)
    pull = torch.randn_like(found)
    gradients = torch.autograd.grad(found, parameters, pull, retain_graph=True)
    wanted = torch.autograd.grad(plain(), parameters, pull)

    torch.testing.assert_close(found, plain(), atol=1e-5, rtol=1e-5)
    for gradient, other in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(gradient, other, atol=2e-3, rtol=1e-3)
