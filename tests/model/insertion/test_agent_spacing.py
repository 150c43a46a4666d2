"""What agents say of the cells and offset bins around them, by the gaps to their boxes."""

from dataclasses import replace

import pytest
import torch

from infgen.model.batching.batch import collate
from infgen.model.insertion.agent_spacing import (
    MAX_SWEPT_M,
    REACH_M,
    SWEPT_TOKENS,
    AgentSpacing,
    CellSpacing,
    OffsetSpacing,
    SpacedAgents,
    swept,
)
from infgen.model.neighbours import cell_pose
from infgen.tokens.grid import make_grid

WIDTH, SPACING = 8, 4
EGO = torch.tensor([[30.0, -20.0, 0.7]])
CLOSE = {"atol": 1e-5, "rtol": 1e-5}


@pytest.fixture
def grid(grid_settings):
    return make_grid(grid_settings)


def begun(spacing):
    """A spacing whose queries make something of what agents say."""
    spacing.begin_at_zero()
    torch.nn.init.normal_(spacing.ask.weight, generator=torch.Generator().manual_seed(1))
    return spacing.eval()


@pytest.fixture
def spacing(grid):
    torch.manual_seed(0)
    return begun(CellSpacing(WIDTH, SPACING, grid))


def around(*places_m, heading_rad=0.3, ego_pose=EGO, size_lw_m=(4.8, 2.0)):
    """Agents alike at places in the grid frame around one ego."""
    count = len(places_m)
    pose = torch.cat([cell_pose(ego_pose[0], torch.tensor(x))[None] for x in places_m])
    pose[:, 2] = heading_rad + ego_pose[0, 2]
    features = torch.randn(1, WIDTH, generator=torch.Generator().manual_seed(2))
    return SpacedAgents(
        features.expand(count, WIDTH),
        torch.arange(count)[None],
        pose[None],
        torch.tensor(size_lw_m).expand(1, count, 2),
        torch.ones((1, count), dtype=torch.bool),
    )


def logits_of(spacing, agents, x=None, ego_pose=EGO):
    """Logits of cells for one query that sees all agents [cell]."""
    x = torch.ones((1, 1, WIDTH)) if x is None else x
    laid = torch.zeros((1, spacing.num_cells + 1, SPACING))
    said = spacing.cells(ego_pose, agents)
    spacing.lay_out(said.query, said.cell, said.keys, laid)
    return spacing.choose(x, laid)[0, 0]


def test_a_gap_begins_at_the_end_of_the_box():
    spacing = begun(AgentSpacing(WIDTH, SPACING))
    features = torch.ones((2, WIDTH))
    sizes_lw_m = torch.tensor([[4.0, 2.0], [6.0, 3.0]])
    ahead_m = torch.tensor([[[5.0, 0.0]], [[6.0, 0.0]]])  # 3 m before either.
    for turned_rad in (0.0, 2.0):
        angle = torch.full((2,), turned_rad)
        cos, sin = angle.cos()[0], angle.sin()[0]
        turn = torch.stack([torch.stack([cos, sin]), torch.stack([-sin, cos])])
        one, other = spacing(features, angle, sizes_lw_m, ahead_m @ turn)[:, 0]
        fades = [1 - (x / REACH_M) ** 2 for x in (5.0, 6.0)]
        torch.testing.assert_close(one / fades[0], other / fades[1], **CLOSE)


def test_within_a_box_all_points_are_alike_but_for_the_distance():
    spacing = begun(AgentSpacing(WIDTH, SPACING))
    inside_m = torch.tensor([[[1.0, 0.5], [-1.0, -0.5], [0.5, -1.0]]])  # As far away.
    said = spacing(
        torch.ones((1, WIDTH)), torch.zeros(1), torch.tensor([[4.0, 2.0]]), inside_m
    )
    torch.testing.assert_close(said[0, 0], said[0, 1], **CLOSE)
    torch.testing.assert_close(said[0, 0], said[0, 2], **CLOSE)


def test_what_a_box_sweeps_within_a_second_is_part_of_it():
    heading_rad = 0.3
    way = torch.tensor([torch.cos(torch.tensor(0.3)), torch.sin(torch.tensor(0.3))])
    pose = torch.tensor([[5.0, -2.0, heading_rad]]).expand(4, 3)
    step_m = torch.stack([0 * way, 3 * way, -3 * way, 100 * way])

    moved, size_lw_m = swept(pose, torch.tensor([[4.0, 2.0]]).expand(4, 2), step_m)

    ahead_m = torch.tensor([0.0, SWEPT_TOKENS * 3, 0.0, MAX_SWEPT_M])
    torch.testing.assert_close(size_lw_m[:, 0], 4 + ahead_m)
    assert (size_lw_m[:, 1] == 2).all()
    rear_m = moved[:, :2] - size_lw_m[:, :1] / 2 * way
    torch.testing.assert_close(rear_m, (pose[:, :2] - 2 * way))
    assert (moved[:, 2] == heading_rad).all()


def test_an_agent_speaks_for_cells_within_reach_and_no_others(spacing, grid):
    place_m = grid.centre_m[grid.ego_cell] + 1.3

    logits = logits_of(spacing, around(place_m)).detach()

    away_m = torch.from_numpy(grid.centre_m - place_m).norm(dim=1)
    assert (logits[away_m > REACH_M] == 0).all()
    assert (logits[away_m < REACH_M - 1] != 0).all()


def test_the_same_scene_elsewhere_has_the_same_logits(spacing):
    places_m = [[3.0, 8.0], [-12.0, 5.5], [40.0, -30.0]]
    moved = torch.tensor([[-400.0, 90.0, -2.9]])

    here = logits_of(spacing, around(*places_m))
    there = logits_of(spacing, around(*places_m, ego_pose=moved), ego_pose=moved)

    torch.testing.assert_close(here, there, atol=1e-4, rtol=1e-4)


def test_logits_follow_an_agent_without_a_jump(spacing, grid):
    edge_m = grid.step_m / 2
    before, after = (
        logits_of(spacing, around([edge_m + off_m, 0.0])) for off_m in (-1e-3, 1e-3)
    )
    assert before.abs().max() > 0.01
    torch.testing.assert_close(before, after, atol=2e-3, rtol=0.0)


def test_what_agents_say_is_added_up_and_ends_at_the_edge_of_the_grid(spacing, grid):
    inside, edge = [5.0, 5.0], [grid.radius_m + 3, 0.0]
    far = [grid.radius_m + REACH_M + 2 * grid.step_m, 0.0]
    both = logits_of(spacing, around(inside, edge, far))
    alone = [logits_of(spacing, around(each)) for each in (inside, edge, far)]
    torch.testing.assert_close(both, sum(alone), **CLOSE)
    assert (alone[1] != 0).any()
    assert not alone[2].any()


def test_slots_see_agents_of_the_turns_before(spacing):
    agents = around([0.0, 4.0], [6.0, 4.0], [-3.0, -8.0])
    turn = torch.tensor([[-1, 0, 1]])
    x = torch.randn((1, 3, WIDTH), generator=torch.Generator().manual_seed(3))

    by_slot = spacing.choose_each(x, spacing.cells(EGO, agents), turn)

    for slot in range(3):
        seen = replace(agents, present=turn < slot)
        one = logits_of(spacing, seen, x[:, slot : slot + 1])
        torch.testing.assert_close(by_slot[0, slot], one, **CLOSE)


def test_agents_that_are_not_there_count_nothing_where_all_are_looked_at(
    spacing, grid, monkeypatch
):
    """As on a device, where the host does not wait to know who is there."""
    agents = around([0.0, 4.0], [6.0, 4.0], [-3.0, -8.0])
    some = replace(agents, present=torch.tensor([[True, False, True]]))
    offsets = begun(OffsetSpacing(WIDTH, SPACING, grid))
    x = torch.ones((1, WIDTH))
    own = logits_of(spacing, some), offsets.choose(x, EGO, some)

    def every(inside):
        at = torch.arange(inside.numel())
        counts = inside.flatten()[:, None].float()
        return at // inside.shape[1], at % inside.shape[1], counts

    monkeypatch.setattr("infgen.model.insertion.agent_spacing.chosen", every)

    torch.testing.assert_close(logits_of(spacing, some), own[0], **CLOSE)
    torch.testing.assert_close(offsets.choose(x, EGO, some), own[1], **CLOSE)


def test_offset_bins_know_gaps_as_cells_do(grid):
    torch.manual_seed(0)
    cells = begun(CellSpacing(WIDTH, SPACING, grid))
    offsets = begun(OffsetSpacing(WIDTH, SPACING, grid))
    offsets.load_state_dict(cells.state_dict())
    agents = around([3.0, 4.0], [-2.0, 1.0])
    x = torch.ones((1, WIDTH))

    said = offsets.choose(x, EGO, agents)[0]

    # To a bin agents are as to the ego's cell, had they been moved by as much.
    for at in (0, 77, 143):
        moved = [torch.tensor(p) - offsets.offset_m[at] for p in ([3.0, 4.0], [-2.0, 1.0])]
        logits = logits_of(cells, around(*(m.tolist() for m in moved)))
        torch.testing.assert_close(said[at], logits[grid.ego_cell], atol=1e-4, rtol=1e-4)


def test_it_changes_where_agents_are_inserted_and_not_whether(
    tiny, new_network, record, limits
):
    spaced = replace(tiny, agent_spacing_width=SPACING, offset_token=True)
    network = new_network(spaced).eval()
    batch = collate([record(3, tokens=9), record(4, agents=9)], limits, 7)
    before = network(batch)
    with torch.no_grad():
        for part in (network.cells.spacing, network.details.spacing):
            part.ask.weight.normal_()

    after = network(batch)

    assert torch.equal(before.entries.add_logit, after.entries.add_logit)
    assert not torch.allclose(before.entries.position_logits, after.entries.position_logits)
    assert not torch.allclose(before.details.offset_logits, after.details.offset_logits)


def test_without_cells_or_offset_tokens_there_is_none(tiny, new_network):
    spaced = replace(tiny, agent_spacing_width=SPACING)
    for without, parts in (
        ({"position_token": False}, set()),
        ({}, {"cells"}),
        ({"offset_token": True}, {"cells", "details"}),
    ):
        network = new_network(replace(spaced, **without))
        names = [n for n, _ in network.named_parameters() if ".spacing." in n]
        assert {name.split(".")[0] for name in names} == parts
