"""The nearest map tokens by squares: the same as by looking at all of them."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from infgen.model import map_grid
from infgen.model.map_grid import SIDE_M, MapGrid
from infgen.model.relations import nearest


def maps(*roads, extent_m=120.0, seed=0):
    """Padded maps of so many tokens each."""
    torch.manual_seed(seed)
    pose = torch.rand(len(roads), max(roads), 3) * extent_m
    real = torch.arange(max(roads)) < torch.tensor(roads)[:, None]
    return pose, real


def by_looking_at_all(pose, real, xy_m, scene, radius_m, count, itself=None):
    allowed = real[scene]
    if itself is not None:
        allowed = allowed & (torch.arange(real.shape[1]) != itself[:, None])
    source_m = pose[scene][..., :2]
    return nearest(xy_m[:, None], source_m, allowed[:, None], radius_m, count)


@given(
    st.integers(0, 1000),
    st.lists(st.integers(1, 60), min_size=1, max_size=3),
    st.sampled_from([1.0, SIDE_M, 30.0, 500.0]),
    st.integers(1, 70),
)
@settings(max_examples=50)
def test_neighbours_are_those_of_the_whole_map(seed, roads, radius_m, count):
    pose, real = maps(*roads, seed=seed)
    xy_m = torch.rand(20, 2) * 200 - 40  # Some of it beside the map.
    scene = torch.randint(len(roads), (20,))
    # Some look from where a token is, or exactly as far away as they can see.
    xy_m[:5] = pose[scene[:5], 0, :2]
    xy_m[5:10, 0] = pose[scene[5:10], 0, 0] + radius_m

    found = MapGrid.of(pose, real).nearest(xy_m, scene, radius_m, count)

    wanted = by_looking_at_all(pose, real, xy_m, scene, radius_m, count)
    assert torch.equal(found.present[0], wanted.present[:, 0])
    assert torch.equal(found.index[0], wanted.index[:, 0])


@pytest.mark.parametrize("kept", [90, 1 << 14])
@pytest.mark.parametrize("count", [1, 8, 70])
def test_lists_of_cells_miss_no_neighbour_as_places_move(monkeypatch, kept, count):
    monkeypatch.setattr(map_grid, "KEPT_CELLS", kept)
    pose, real = maps(300, 40, 0, extent_m=60.0)
    scene = torch.arange(3).repeat(40)
    xy_m = torch.rand(len(scene), 2) * 7 + 20
    xy_m[0] = -1e7  # As far away as no cell has a number.
    grid = MapGrid.of(pose, real)

    for _ in range(6):
        found = grid.nearest(xy_m, scene, 12.0, count)

        wanted = by_looking_at_all(pose, real, xy_m, scene, 12.0, count)
        assert torch.equal(found.present[0], wanted.present[:, 0])
        assert torch.equal(found.index[0], wanted.index[:, 0])
        assert len(grid.lists[12.0, count].cell) <= kept
        xy_m = xy_m + 1.3


def test_a_cell_lists_few_tokens_once():
    pose, real = maps(5000, extent_m=300.0)
    grid = MapGrid.of(pose, real)
    xy_m = torch.full((100, 2), 150.0) + torch.rand(100, 2)
    scene = torch.zeros(100, dtype=torch.int64)

    grid.nearest(xy_m, scene, 30.0, 16)
    first = grid.lists[30.0, 16]
    grid.nearest(xy_m.flip(0), scene, 30.0, 16)

    assert len(first.cell) <= 4  # A metre may lie in two of them, either way.
    assert 16 <= int(first.length.min()) <= int(first.length.max()) < 60  # Of 157.
    assert grid.lists[30.0, 16].at is first.at


def test_a_token_is_not_its_own_neighbour():
    pose, real = maps(40, 25)
    scene, itself = real.nonzero().T

    xy_m = pose[scene, itself, :2]
    found = MapGrid.of(pose, real).nearest(xy_m, scene, 25.0, 8, itself=itself)

    wanted = by_looking_at_all(pose, real, xy_m, scene, 25.0, 8, itself)
    assert torch.equal(found.index[0], wanted.index[:, 0])
    assert not (found.present[0] & (found.index[0] == itself[:, None])).any()


def test_few_are_looked_at_on_a_large_map():
    pose, real = maps(5000, extent_m=1000.0)

    _, there = MapGrid.of(pose, real)._listed(
        torch.full((1, 2), 500.0), torch.zeros(1, dtype=torch.int64), 30.0
    )

    assert 0 < int(there.sum()) < 60
    assert there.shape[1] < 150


@pytest.mark.parametrize("real", [torch.zeros(2, 5), torch.zeros(2, 0)])
def test_maps_without_tokens_have_no_neighbours(real):
    pose = torch.zeros(*real.shape, 3)
    grid = MapGrid.of(pose, real.bool())

    found = grid.nearest(torch.zeros(3, 2), torch.tensor([0, 1, 1]), 30.0, 4)

    assert not found.present.any()


def test_nobody_looks():
    grid = MapGrid.of(*maps(10))

    found = grid.nearest(torch.zeros(0, 2), torch.zeros(0, dtype=torch.int64), 30.0, 4)

    assert found.index.shape[:2] == (1, 0)
