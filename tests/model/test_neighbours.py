"""Rows of groups that see each other: listed in order, or the nearest ones of each."""

from dataclasses import replace

import pytest
import torch

from infgen.config import ModelSettings
from infgen.model.layers import Attention, normed
from infgen.model.neighbours import NeighbourSpec, find_neighbours, find_others
from infgen.model.relations import Rows, relation_embedding

SETTINGS = ModelSettings(width=16, heads=2, fourier_bands=4, dropout=0.0)
RADIUS_M, COUNT, GROUPS, PLACES = 60.0, 6, 4, 9


def make_spec(relations="features"):
    torch.manual_seed(3)
    settings = replace(SETTINGS, relations=relations)
    return NeighbourSpec.of(RADIUS_M, COUNT, relation_embedding(RADIUS_M, settings))


def make_groups():
    """Poses, some too far apart to be seen; groups of 5, 0, 1 and 7 of nine places."""
    torch.manual_seed(4)
    pose = torch.randn(GROUPS, PLACES, 3) * torch.tensor([50.0, 50.0, 2.0])
    visible = torch.zeros(GROUPS, PLACES, dtype=torch.bool)
    visible[0, 2:7], visible[2, 4], visible[3, :7] = True, True, True
    return pose, visible


def listed_nearest(spec, rows, pose, visible):
    others = ~torch.eye(PLACES, dtype=torch.bool)
    allowed = visible[:, None] & visible[:, :, None] & others
    return find_neighbours(spec, rows, pose, pose, rows.number, allowed)


def seen_rows(neighbours):
    pairs = zip(neighbours.index, neighbours.present, strict=True)
    return [set(index[present].tolist()) for index, present in pairs]


def test_all_rows_of_small_groups_are_listed_and_the_same_ones_are_seen():
    spec, (pose, visible) = make_spec(), make_groups()
    rows = Rows.where(visible)

    found = find_others(spec, rows, pose, visible)
    nearest = listed_nearest(spec, rows, pose, visible)

    assert found.groups == (slice(0, 5), slice(5, 6), slice(6, 13))
    assert found.index.shape == (13, 7)
    assert seen_rows(found) == seen_rows(nearest)
    assert any(len(row) < 4 for row in seen_rows(found)[:5])  # Some are too far away.
    group = (rows.at // PLACES)[:, None]
    there = rows.number[group, found.place] == found.index
    assert there[found.present].all()


def test_larger_groups_are_lists_of_the_nearest():
    spec, (pose, visible) = make_spec(), make_groups()
    visible[3] = True
    rows = Rows.where(visible)

    found = find_others(spec, rows, pose, visible)

    assert found.groups is None
    assert seen_rows(found) == seen_rows(listed_nearest(spec, rows, pose, visible))


def test_nobody_sees_nobody():
    pose, visible = torch.zeros(GROUPS, PLACES, 3), torch.zeros(GROUPS, PLACES) > 0

    assert not len(find_others(make_spec(), Rows.where(visible), pose, visible).index)


@pytest.mark.parametrize("relations", ["features", "rotary"])
@pytest.mark.parametrize("dropout", [0.0, 0.3])
def test_attention_within_groups_is_that_over_lists_and_so_are_its_gradients(
    relations, dropout
):
    pose, visible = make_groups()
    rows, spec = Rows.where(visible), make_spec(relations)
    layer = Attention(
        replace(SETTINGS, relations=relations, dropout=dropout), bipartite=False
    )
    x = torch.randn(len(rows.at), SETTINGS.width, requires_grad=True)
    inputs = [x, *layer.parameters(), *spec.relation.parameters()]
    pull = torch.randn(len(rows.at), SETTINGS.width)

    def run(groups):
        found = find_others(spec, rows, pose, visible)
        seen = (found if groups else replace(found, groups=None)).seen(normed(x))
        torch.manual_seed(7)  # Of dropout.
        updated = layer(x, seen)
        return updated, *torch.autograd.grad(
            updated, inputs, pull, allow_unused=True, retain_graph=True
        )

    for one, other in zip(run(True), run(False), strict=True):
        if one is None:
            assert other is None
        else:
            torch.testing.assert_close(one, other, atol=2e-5, rtol=1e-4)
