"""Who sees whom, and how they stand to each other, on scenes that fit in the head."""

import math

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from infgen.model.neighbours import NeighbourSpec, cell_pose, find_neighbours
from infgen.model.relations import (
    Rows,
    across,
    direction,
    nearest,
    relation_embedding,
    relations,
    within_radius,
)
from infgen.model.settings import ModelSettings


def line(*x_m):
    return torch.tensor([[[float(x), 0.0] for x in x_m]])


def everyone(target, source):
    return torch.ones(1, target.shape[1], source.shape[1], dtype=torch.bool)


def test_the_nearest_come_first_and_no_more_than_asked_for():
    target, source = line(0), line(5, 1, 3, 9)

    found = nearest(target, source, everyone(target, source), radius_m=8.0, count=2)

    assert found.index.tolist() == [[[1, 2]]]
    assert found.present.tolist() == [[[True, True]]]


def test_sources_beyond_the_radius_are_not_seen_and_those_on_it_are():
    target, source = line(0), line(5, 8, 9)

    found = nearest(target, source, everyone(target, source), radius_m=8.0, count=3)

    assert found.index[found.present].tolist() == [0, 1]


def test_ties_go_by_position():
    target, source = line(0), line(2, -2, 2, 2)

    found = nearest(target, source, everyone(target, source), radius_m=8.0, count=3)

    assert found.index.tolist() == [[[0, 1, 2]]]


def test_lists_are_no_longer_than_the_longest_and_padded_with_the_first_source():
    target, source = line(0, 100), line(0, 1, 2, 3)

    found = nearest(target, source, everyone(target, source), radius_m=2.0, count=4)

    assert found.index.tolist() == [[[0, 1, 2], [0, 0, 0]]]
    assert found.present.tolist() == [[[True] * 3, [False] * 3]]


def test_what_is_not_allowed_is_not_seen():
    target, source = line(0), line(1, 2, 3)
    allowed = torch.tensor([[[False, True, True]]])

    found = nearest(target, source, allowed, radius_m=9.0, count=1)

    assert found.index.tolist() == [[[1]]]


@pytest.mark.parametrize(("targets", "sources"), [(0, 3), (3, 0), (0, 0)])
def test_nobody_sees_nobody(targets, sources):
    target, source = torch.zeros(2, targets, 2), torch.zeros(2, sources, 2)
    allowed = torch.ones(2, targets, sources, dtype=torch.bool)

    found = nearest(target, source, allowed, radius_m=9.0, count=4)

    assert found.index.shape[:2] == (2, targets)
    assert not found.present.any()


@settings(max_examples=25)
@given(st.integers(0, 1000), st.integers(1, 12), st.integers(1, 30), st.integers(1, 8))
@example(366, 8, 28, 8)
def test_neighbours_are_those_that_sorting_all_distances_finds(seed, rows, many, count):
    torch.manual_seed(seed)
    target, source = torch.rand(2, rows, 2) * 20, torch.rand(2, many, 2) * 20
    allowed = torch.rand(2, rows, many) < 0.8

    found = nearest(target, source, allowed, radius_m=7.0, count=count)

    distance_m = torch.cdist(target.double(), source.double())
    distance_m[~allowed] = math.inf
    best = distance_m.sort(dim=-1).values[..., :count]
    best = best[..., : found.index.shape[-1]]
    # Who is absent counts as at the radius, where rounding decides who is within it.
    mine = torch.where(found.present, distance_m.gather(-1, found.index), 7.0)
    torch.testing.assert_close(mine, best.clamp(max=7.0), atol=1e-2, rtol=0.0)


def test_large_searches_are_cut_in_blocks_with_the_same_result(monkeypatch):
    torch.manual_seed(0)
    xy_m = torch.rand(1, 50, 2) * 30
    allowed = torch.ones(1, 1, 50, dtype=torch.bool)
    whole = nearest(xy_m, xy_m, allowed, 9.0, 5)

    monkeypatch.setattr("infgen.model.relations.BLOCK_PAIRS", 150)
    blocks = nearest(xy_m, xy_m, allowed, 9.0, 5)

    assert torch.equal(whole.index, blocks.index)
    assert torch.equal(whole.present, blocks.present)


def test_a_neighbour_ahead_to_the_left_facing_back():
    target = torch.tensor([[0.0, 0.0, math.pi / 2]])  # Faces +y.
    source = torch.tensor([[[-3.0, 4.0, -math.pi / 2]]])

    found = relations(target, source)[0, 0]

    left_rad = math.atan2(3, 4)
    assert found[:2].tolist() == pytest.approx([5.0, left_rad], abs=1e-5)
    assert abs(found[2]) == pytest.approx(math.pi, abs=1e-5)


def test_across_is_how_far_off_a_lane_one_drives_wherever_the_lane_began():
    target = torch.tensor([[7.0, 2.0, 0.3], [0.0, 5.0, 0.0]])
    lane = torch.tensor([[[0.0, 0.5, 0.0], [-50.0, 0.5, 0.0]], [[1.0, 0.0, 1.57080]] * 2])

    left_m = across(target, lane)[..., 0]

    assert left_m.tolist()[0] == pytest.approx([1.5, 1.5])
    assert left_m.tolist()[1] == pytest.approx([1.0, 1.0], abs=1e-4)


@pytest.mark.parametrize(("ahead_m", "seen"), [(0.0, {1, 2}), (6.0, {2, 3})])
def test_who_looks_ahead_sees_what_lies_there_rather_than_behind(ahead_m, seen):
    relation = relation_embedding(20.0, ModelSettings(width=8, fourier_bands=2))
    reach = NeighbourSpec.of(20.0, 2, relation, ahead_m=ahead_m)
    facing = 2.0
    way = torch.tensor([math.cos(facing), math.sin(facing)])
    along_m = torch.tensor([-4.0, -1.0, 2.0, 7.0])
    source = torch.cat([along_m[:, None] * way, torch.zeros(4, 1)], dim=-1)[None]
    target = torch.tensor([[[0.0, 0.0, facing]]])
    one = Rows.where(torch.ones(1, 1, dtype=torch.bool))

    found = find_neighbours(
        reach, one, target, source, torch.arange(4)[None], torch.ones(1, 1, 4).bool()
    )

    assert set(found.index[0].tolist()) == seen


@pytest.mark.parametrize("heading_rad", [0.0, 1.0, -3.0, math.pi])
@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_who_stands_in_the_same_place_is_in_no_direction(heading_rad, zero):
    # atan2(0, -0) is pi: SPEC D81.
    away_m = torch.tensor([[-0.0, zero]])

    assert direction(away_m, torch.tensor([heading_rad])).tolist() == [0.0]


def test_within_radius_agrees_with_nearest():
    torch.manual_seed(0)
    one, others = torch.zeros(1, 1, 3), torch.rand(1, 500, 3) * 20
    found = nearest(
        one[..., :2], others[..., :2], torch.ones(1, 1, 500, dtype=torch.bool), 9.0, 500
    )

    inside = within_radius(one.expand_as(others), others, 9.0)

    assert sorted(found.index[found.present].tolist()) == inside[0].nonzero()[:, 0].tolist()


def test_rows_come_back_to_their_places():
    real = torch.tensor([[True, False, True], [False, True, False]])
    values = torch.arange(6).view(2, 3)
    rows = Rows.where(real)

    assert rows.pack(values).tolist() == [0, 2, 4]
    assert rows.spread(rows.pack(values)).tolist() == [[0, 0, 2], [0, 4, 0]]
    assert rows.number[real].tolist() == [0, 1, 2]


def test_a_cell_ahead_of_the_ego_is_ahead_in_the_world():
    ego = torch.tensor([[10.0, 20.0, 0.0]])  # Faces +x.
    ahead_m = torch.tensor([[0.0, 6.0]])  # Grid frame: +y is ahead.

    pose = cell_pose(ego, ahead_m)

    torch.testing.assert_close(pose, torch.tensor([[16.0, 20.0, 0.0]]))
