"""A closer look at cells: it says where agents are inserted, not whether."""

from dataclasses import replace

import pytest
import torch
from pydantic import ValidationError

from infgen.config import ModelSettings
from infgen.model.batching.batch import collate
from infgen.model.insertion.cell_features import CellFeatures, CellSources
from infgen.model.insertion.cell_refinement import lattice_centres_m
from infgen.model.neighbours import cell_pose
from infgen.tokens.grid import make_grid
from infgen.tokens.scene_tokens import NO_CELL

WIDTH, FEATURES, REFINED = 8, 5, 8
EGO = torch.tensor([[3.0, -2.0, 0.4]])


@pytest.fixture
def grid(grid_settings):
    return make_grid(grid_settings)


@pytest.fixture
def cell_features(grid):
    torch.manual_seed(0)
    return CellFeatures(WIDTH, FEATURES, REFINED, grid).eval()


def lying(*positions_m):
    """Things at places in the grid frame, one query around them all."""
    features = torch.randn(len(positions_m), WIDTH, generator=torch.Generator())
    poses = [cell_pose(EGO[0], torch.tensor(x)).tolist() for x in positions_m]
    pose = torch.tensor(poses, dtype=torch.float32).view(1, -1, 3)
    row = torch.arange(len(positions_m))[None]
    return CellSources(features, row, pose, torch.ones_like(row, dtype=torch.bool))


def test_lattice_points_are_where_the_grid_has_its_cells(grid):
    centre_m = lattice_centres_m(len(grid.cell_at), grid.step_m)

    inside = grid.cell_at.flatten() != NO_CELL
    expected = torch.from_numpy(grid.centre_m[grid.cell_at.flatten()[inside]])
    torch.testing.assert_close(centre_m[torch.from_numpy(inside)], expected)


def test_a_thing_speaks_for_the_cells_up_to_three_away(cell_features, grid):
    centre_m = grid.centre_m[grid.ego_cell]
    nothing = lying()

    with torch.no_grad():
        some, none = (
            cell_features(EGO, things, nothing)[..., FEATURES:]
            for things in (lying(centre_m), nothing)
        )

    found = set(((some - none)[0].abs().amax(dim=-1) > 1e-6).nonzero()[:, 0].tolist())
    gap_m = abs(grid.centre_m - centre_m).max(axis=1)
    assert found == set((gap_m < 3.5 * grid.step_m).nonzero()[0].tolist())


def test_it_changes_where_agents_are_inserted_and_not_whether(
    tiny, new_network, record, limits
):
    network = new_network(replace(tiny, cell_refinement_width=REFINED)).eval()
    batch = collate([record(3, tokens=9), record(4, agents=9)], limits, 7)
    before = network(batch).entries
    with torch.no_grad():
        network.cells.cell_features.refinement.key.weight.normal_()

    after = network(batch).entries

    assert torch.equal(before.add_logit, after.add_logit)
    assert not torch.allclose(before.position_logits, after.position_logits)


def test_without_cells_or_their_features_there_is_none(tiny, new_network):
    for without in ({"position_token": False}, {"cell_feature_width": 0}):
        network = new_network(replace(tiny, cell_refinement_width=REFINED, **without))
        names = [name for name, _ in network.named_parameters() if "refinement" in name]
        assert not names


def test_a_width_that_does_not_make_four_groups_is_refused():
    with pytest.raises(ValidationError, match="is 6; expected a multiple of 4"):
        ModelSettings(cell_refinement_width=6)


def test_under_autocast_its_convolutions_are_in_float32(cell_features, grid):
    near = lying(grid.centre_m[grid.ego_cell])
    found = []
    for convolution in (cell_features.refinement.near, cell_features.refinement.far):
        convolution.register_forward_hook(lambda _, __, out: found.append(out.dtype))

    with torch.autocast("cpu", torch.bfloat16):
        cell_features(EGO, near, near)

    assert found == [torch.float32] * 2
