"""What temporal attention is too short for: averages of density, and standing agents."""

from dataclasses import replace

import pytest
import torch

from infgen.model.batching.batch import collate
from infgen.model.long_memory import (
    AVERAGED_TOKENS,
    Standing,
    averages_before,
    count_around,
    moves_between,
    next_averages,
    standing_after,
    standing_at,
)
from infgen.model.token_step import TokenStep
from infgen.tokens.scene_tokens import Presence


def random(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def test_averages_of_all_token_steps_are_those_of_one_after_the_other():
    count = (30 * random(3, 15)).round()

    together = averages_before(count)

    average = torch.zeros(3, len(AVERAGED_TOKENS))
    for token in range(count.shape[1]):
        first = torch.full((3,), token == 0)
        before = torch.where(first[:, None], count[:, token, None], average)
        torch.testing.assert_close(together[:, token], before)
        average = next_averages(average, count[:, token], first)


def test_an_average_of_always_the_same_number_is_that_number():
    torch.testing.assert_close(
        averages_before(torch.full((1, 40), 7.0)), torch.full((1, 40, 2), 7.0)
    )


def test_after_its_time_constant_an_average_has_gone_63_percent_of_a_jump():
    count = torch.tensor([[0.0] + [1.0] * 61])

    fast, slow = averages_before(count).unbind(-1)

    assert float(fast[0, 7]) == pytest.approx(1 - (5 / 6) ** 6)
    assert float(slow[0, 61]) == pytest.approx(0.635, abs=0.005)


def test_agents_are_counted_within_the_radius_only_if_they_are_visible():
    ego_pose = torch.tensor([[10.0, 0.0, 0.0]])
    pose = torch.tensor([[[10.0, 0, 0], [40.0, 40, 0], [10.0, 51, 0], [11.0, 0, 0]]])
    visible = torch.tensor([[True, True, True, False]])

    assert count_around(ego_pose, pose, visible, 50.0).tolist() == [2.0]


def column(pose, presence, observed):
    zeros = torch.zeros_like(presence)
    size_lwh_m = torch.zeros(*presence.shape, 3)
    return TokenStep(zeros, size_lwh_m, pose, zeros, presence, observed, zeros)


def test_standing_of_all_token_steps_is_that_of_one_after_the_other():
    tokens, shape = 20, (2, 20, 6)
    presence = torch.full(shape, int(Presence.PRESENT))
    presence[random(*shape, seed=1) < 0.1] = int(Presence.INSERTED)
    presence[:, 0] = int(Presence.INSERTED)
    visible = (random(*shape, seed=2) < 0.8) | (presence == int(Presence.INSERTED))
    steps_m = torch.where(random(*shape, seed=3) < 0.5, 0.1, 2.0)
    pose = torch.zeros(*shape, 3)
    pose[..., 0] = steps_m.cumsum(dim=1)
    before = torch.cat([pose[:, :1], pose[:, :-1]], dim=1)
    known = torch.cat([torch.zeros_like(visible[:, :1]), visible[:, :-1]], dim=1)
    moves = moves_between(before, known, pose, presence) & visible

    together = standing_at(presence, moves)

    standing = Standing.unknown(visible[:, 0])
    for token in range(tokens):
        now = column(pose[:, token], presence[:, token], visible[:, token])
        standing = standing_after(standing, before[:, token], known[:, token], now)
        assert torch.equal(together.tokens[:, token], standing.tokens)
        assert torch.equal(together.moved[:, token], standing.moved)
    assert together.moved.any()
    assert not together.moved.all()
    assert int(together.tokens.max()) > 2


def test_who_is_inserted_has_neither_stood_nor_moved():
    presence = torch.tensor([[[1], [1], [2], [1]]])
    moves = torch.tensor([[[False], [True], [False], [False]]])

    standing = standing_at(presence, moves)

    assert standing.tokens.flatten().tolist() == [0, 0, 0, 1]
    assert standing.moved.flatten().tolist() == [False, True, False, False]


@pytest.fixture
def batch(record, limits):
    return collate([record(3, tokens=9), record(4, agents=9)], limits, 7)


def test_untrained_features_change_no_logit(tiny, new_network, batch):
    plain = new_network(tiny).eval()
    features = (
        *("density_features", "ego_features", "standing_features"),
        *("removal_features", "approach_features", "latent_rates", "last_move_head"),
        "over_edge_head",
    )
    widths = {
        "cell_refinement_width": 8,
        "agent_spacing_width": 4,
        "clearance_width": 8,
        "edge_clearance_width": 8,
    }
    every = replace(tiny, **widths, **dict.fromkeys(features, True))
    network = new_network(every).eval()
    network.load_state_dict(plain.state_dict(), strict=False)
    for part in network.added_parts().values():
        part.begin_at_zero()

    one, two = plain(batch), network(batch)

    assert len(network.added_parts()) == 14
    assert torch.equal(one.motion.motion_logits, two.motion.motion_logits)
    assert torch.equal(one.motion.remove_logit, two.motion.remove_logit)
    assert torch.equal(one.entries.add_logit, two.entries.add_logit)
    assert torch.equal(one.entries.position_logits, two.entries.position_logits)


@pytest.mark.parametrize("features", ["density_features", "ego_features"])
def test_insertion_and_removal_see_the_scene_and_motion_does_not(
    tiny, new_network, batch, features
):
    network = new_network(replace(tiny, **{features: True})).eval()
    before = network(batch)
    with torch.no_grad():
        for part in network.added_parts().values():
            part.embed[-1].bias += 1

    after = network(batch)

    assert torch.equal(before.motion.motion_logits, after.motion.motion_logits)
    assert not torch.equal(before.motion.remove_logit, after.motion.remove_logit)
    assert not torch.equal(before.entries.add_logit, after.entries.add_logit)


def test_who_takes_a_row_over_does_not_see_the_past_of_who_had_it(tiny, new_network, batch):
    alone = replace(tiny, agent_agent_radius_m=0.0)  # Others saw who had the row.
    network, agents = new_network(alone).eval(), batch.agents
    presence = agents.presence.clone()
    presence[:, 4, 1] = int(Presence.INSERTED)
    taken_over = replace(agents, presence=presence)
    elsewhere = agents.pose.clone()
    elsewhere[:, :4, 1, :2] += 3.0

    def logits_of_row_1(agents):
        with torch.no_grad():
            motion = network(replace(batch, agents=agents)).motion
        return motion.rows.spread(motion.motion_logits)[:, 4, 1]

    one = logits_of_row_1(taken_over)
    two = logits_of_row_1(replace(taken_over, pose=elsewhere))

    assert torch.equal(one, two)
    three = logits_of_row_1(agents)
    assert not torch.equal(three, logits_of_row_1(replace(agents, pose=elsewhere)))
