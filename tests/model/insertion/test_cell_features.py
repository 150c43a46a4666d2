"""Cells and headings told from the street: what lies where speaks for there."""

import math

import pytest
import torch

from infgen.model.insertion.cell_features import CellFeatures, CellSources
from infgen.model.insertion.detail_features import HeadingFeatures, OffsetFeatures
from infgen.model.neighbours import cell_pose
from infgen.tokens.grid import make_grid

WIDTH, FEATURES = 8, 5


@pytest.fixture
def grid(grid_settings):
    return make_grid(grid_settings)


@pytest.fixture
def cell_features(grid):
    torch.manual_seed(0)
    cell_features = CellFeatures(WIDTH, FEATURES, 0, grid)
    torch.nn.init.normal_(cell_features.place[-1].weight)
    return cell_features.eval()


def lying(*poses, seed=0):
    """Things at poses, one query around them all."""
    features = torch.randn(len(poses), WIDTH, generator=torch.Generator().manual_seed(seed))
    pose = torch.tensor([list(poses)], dtype=torch.float32).view(1, -1, 3)
    row = torch.arange(len(poses))[None]
    return CellSources(features, row, pose, torch.ones_like(row, dtype=torch.bool))


NOTHING = lying()
EGO = torch.tensor([[3.0, -2.0, 0.4]])


def at(grid, cell, turned_rad=0.0, off_m=(0.0, 0.0)):
    """The world's pose of a place in a cell, as the ego of these tests sees it."""
    position_m = torch.from_numpy(grid.centre_m[cell]) + torch.tensor(off_m)
    x, y, heading = cell_pose(EGO[0], position_m).tolist()
    return x, y, heading + turned_rad


def changed(cell_features, things, other):
    """Cells whose features differ between two streets."""
    gap = cell_features(EGO, things, NOTHING) - cell_features(EGO, other, NOTHING)
    return set((gap[0].abs().amax(dim=-1) > 1e-6).nonzero()[:, 0].tolist())


def neighbours(grid, cell):
    gap_m = abs(grid.centre_m - grid.centre_m[cell]).max(axis=1)
    return set((gap_m < 1.5 * grid.step_m).nonzero()[0].tolist())


def test_a_thing_speaks_for_its_cell_and_those_beside_it(cell_features, grid):
    cell = grid.ego_cell + 5
    assert changed(cell_features, lying(at(grid, cell)), NOTHING) == neighbours(grid, cell)


def test_a_thing_between_four_cells_is_shared_out_between_them(cell_features, grid):
    cell, half_m = grid.ego_cell, grid.step_m / 2
    laid = cell_features._cell_sources(
        EGO, lying(at(grid, cell, off_m=(half_m, half_m))), cell_features.road
    )
    whole = cell_features._cell_sources(EGO, lying(at(grid, cell)), cell_features.road)
    some = laid.abs().sum(dim=-1) > 1e-4 * whole.abs().max()
    assert some.sum() == 4
    torch.testing.assert_close(laid[some], whole.amax(dim=0).expand(4, -1) / 4)


def test_things_outside_the_grid_say_nothing(cell_features, grid):
    far = lying(at(grid, grid.ego_cell, off_m=(0.0, 1.5 * grid.radius_m)))
    assert not changed(cell_features, far, NOTHING)


def test_features_follow_a_thing_without_a_jump(cell_features, grid):
    edge_m = grid.step_m / 2
    before, after = (
        cell_features(EGO, lying(at(grid, grid.ego_cell, off_m=(edge_m + e, 0.0))), NOTHING)
        for e in (-1e-3, 1e-3)
    )
    assert (before - after).abs().max() < 5e-3


def test_which_way_a_thing_faces_is_told(cell_features, grid):
    cell = grid.ego_cell + 3
    turned = lying(at(grid, cell, turned_rad=math.pi))
    assert changed(cell_features, lying(at(grid, cell)), turned) <= neighbours(grid, cell)
    assert cell in changed(cell_features, lying(at(grid, cell)), turned)


def test_roads_and_agents_are_told_apart(cell_features, grid):
    thing = lying(at(grid, grid.ego_cell))
    gap = cell_features(EGO, thing, NOTHING) - cell_features(EGO, NOTHING, thing)
    assert gap.abs().max() > 1e-3


def test_a_query_chooses_by_the_products_of_features(cell_features):
    x, cells = torch.randn(2, 3, WIDTH), torch.randn(2, 7, FEATURES)
    logits = cell_features.choose(x, cells)
    asked = cell_features.ask(x[1, 2]) / math.sqrt(FEATURES)
    torch.testing.assert_close(logits[1, 2, 4], asked @ cells[1, 4])


@pytest.fixture
def bearings(grid):
    torch.manual_seed(1)
    return HeadingFeatures(WIDTH, FEATURES, grid.num_headings).eval()


@pytest.mark.parametrize("bins", [1, 7, -3])
def test_turning_a_road_by_some_bins_turns_what_it_says(bearings, grid, bins):
    x, pose = torch.randn(1, WIDTH), torch.zeros(1, 3)
    step_rad = grid.heading_step_rad
    before = bearings(x, pose, lying((1.0, 2.0, 0.3)))
    after = bearings(x, pose, lying((1.0, 2.0, 0.3 + bins * step_rad)))
    assert before.std() > 0
    torch.testing.assert_close(after, before.roll(bins, dims=-1), atol=1e-5, rtol=1e-4)


def test_roads_that_are_not_there_say_nothing(bearings):
    x, pose, roads = torch.randn(1, WIDTH), torch.zeros(1, 3), lying((1.0, 2.0, 0.3))
    gone = CellSources(
        roads.features, roads.row, roads.pose, torch.zeros_like(roads.present)
    )
    torch.testing.assert_close(bearings(x, pose, gone), bearings(x, pose, NOTHING))


def test_several_questions_at_one_place_are_each_of_them(bearings):
    x, pose, roads = torch.randn(1, 4, WIDTH), torch.zeros(1, 3), lying((1.0, 2.0, 0.3))
    for which, together in enumerate(bearings(x, pose, roads)[0]):
        alone = bearings(x[:, which], pose, roads)[0]
        torch.testing.assert_close(together, alone)


def test_no_query_is_no_answer(cell_features, bearings):
    nobody = CellSources(
        torch.randn(0, WIDTH),
        *(x[:0] for x in (lying().row, EGO[:, None])),
        EGO[:0, :0] > 0,
    )
    assert cell_features(EGO[:0], nobody, nobody).shape == (
        0,
        len(cell_features.centre_m),
        FEATURES,
    )
    assert bearings(torch.randn(0, WIDTH), EGO[:0], nobody).shape[0] == 0


@pytest.fixture
def offsets(grid):
    """Offset bins that only the side of a road decides: its left at 1 m, most of all."""
    torch.manual_seed(0)
    offsets = OffsetFeatures(WIDTH, FEATURES, grid).eval()
    offsets.begin_at_zero()
    with torch.no_grad():
        for part in (offsets.road, offsets.asked, offsets.turned):
            part.weight.zero_()
        torch.nn.init.zeros_(offsets.lateral.weight)
        left_m = torch.linspace(-4, 4, 33)
        offsets.lateral.weight[:, 0] = (4 - (left_m - 1).abs()).clamp(min=0)
        offsets.say.weight[0, 0] = 1.0
        for part in (offsets.road, offsets.asked):
            part.bias.zero_()
    return offsets


def bins_of(offsets, roads):
    with torch.no_grad():
        return offsets(torch.zeros((1, WIDTH)), EGO, roads)[0]


@pytest.mark.parametrize(
    ("along_deg", "place"), [(0.0, (-0.5, None)), (90.0, (None, -0.5))]
)
def test_an_offset_bin_is_told_by_how_far_it_lies_beside_a_road(
    offsets, grid, along_deg, place
):
    # Through 0.5 m right of the centre of the cell, 2 m before it; or turned by 90 degrees.
    x_m, y_m = (0.5, -2.0) if along_deg == 0 else (2.0, 0.5)
    x, y, ego_rad = cell_pose(EGO[0], torch.tensor([x_m, y_m])).tolist()
    road = lying((x, y, ego_rad + math.radians(along_deg)))

    logits = bins_of(offsets, road)

    best_m = grid.offset_m[logits.argmax()]
    for found_m, wanted_m in zip(best_m, place, strict=True):
        assert wanted_m is None or abs(found_m - wanted_m) <= grid.offset_step_m / 2 + 1e-6
    left_m = 0.5 - grid.offset_m[:, 0] if along_deg == 0 else 0.5 - grid.offset_m[:, 1]
    wanted = torch.from_numpy(4 - abs(left_m - 1))
    torch.testing.assert_close(logits, wanted, atol=1e-5, rtol=0)


def test_a_road_that_ends_before_the_cell_says_nothing_of_its_offsets(offsets):
    x, y, ego_rad = cell_pose(EGO[0], torch.tensor([0.0, 5.0])).tolist()

    assert not bins_of(offsets, lying((x, y, ego_rad))).abs().max() > 1e-6
    assert bins_of(offsets, lying((x, y, ego_rad + math.pi))).abs().max() > 1


def test_untrained_offset_bins_are_equally_likely(grid):
    offsets = OffsetFeatures(WIDTH, FEATURES, grid)
    offsets.begin_at_zero()

    logits = bins_of(offsets, lying((0.0, 0.0, 0.0)))

    assert len(logits) == len(grid.offset_m)
    assert torch.equal(logits, logits[:1].expand_as(logits))
