"""What the network must not depend on, and what it must not see."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from infgen.config import ModelSettings, TokenSettings
from infgen.model.batching.batch import collate
from infgen.model.network import Network
from infgen.tokens.scene_tokens import Presence
from tests.model.conftest import TINY, VARIANTS, make_network

CLOSE = {"atol": 1e-4, "rtol": 1e-4}
MODELS = {"motion": "motion_logits remove_logit", "entries": "add_logit position_logits"}
DETAILS = "agent_type_logits size_log_m heading_logits offset_m offset_logits"


@pytest.fixture(scope="module", params=["full", "rotary", "offset token"])
def network(request):
    """What must hold does so however relative poses are told."""
    return make_network(replace(TINY, **VARIANTS[request.param])).eval()


@torch.no_grad()
def run(network, records, limits, draw=0):
    batch = collate(records, limits, draw)
    return batch, network(batch, hidden_roads=True)


def all_logits(outputs):
    named = [*MODELS.items(), ("details", DETAILS)]
    found = {
        f"{part}.{name}": getattr(getattr(outputs, part), name)
        for part, names in named
        for name in names.split()
    }
    said = {name: logits for name, logits in found.items() if logits is not None}
    return said | {"roads": outputs.roads.logits}


@pytest.mark.parametrize(
    ("turn_rad", "shift_m"), [(0.0, (200.0, -90.0)), (2.1, (0.0, 0.0)), (-1.3, (30, 80))]
)
def test_turning_and_shifting_the_world_changes_nothing(
    network, record, limits, turned, turn_rad, shift_m
):
    scene = record(5, agents=10, tokens=8)

    _, here = run(network, [scene], limits)
    _, there = run(network, [turned(scene, turn_rad, shift_m)], limits)

    for name, logits in all_logits(here).items():
        torch.testing.assert_close(
            all_logits(there)[name], logits, atol=3e-4, rtol=1e-3, msg=name
        )


def num_rows(outputs, part):
    """How many rows a part of a pass has."""
    return len(getattr(outputs, part).rows.at)


def test_scenes_side_by_side_are_scenes_one_by_one(network, record, limits):
    scenes = [
        record(1, agents=9, tokens=7, roads=60),
        record(2, agents=4, tokens=12, roads=20),
        record(3, agents=14, tokens=3, roads=90),
    ]
    _, together = run(network, scenes, limits)

    rows = {"motion": 0, "entries": 0, "details": 0}
    for scene in scenes:
        _, alone = run(network, [scene], limits)
        for part, names in [*MODELS.items(), ("details", DETAILS)]:
            start = rows[part]
            for name in names.split():
                one = getattr(getattr(alone, part), name)
                all_of_them = getattr(getattr(together, part), name)
                if one is None:  # Offsets are regressed or bins, never both.
                    assert all_of_them is None
                    continue
                mine = all_of_them[start : start + len(one)]
                if part == "entries":  # Padded to the longest list of inserted agents.
                    mine = mine[:, : one.shape[1]]
                torch.testing.assert_close(mine, one, **CLOSE, msg=f"{part}.{name}")
            rows[part] += num_rows(alone, part)


def test_padding_changes_nothing(network, record, limits):
    scene, long = record(1, agents=5, tokens=4), record(2, agents=20, tokens=15, roads=150)

    _, alone = run(network, [scene], limits)
    _, padded = run(network, [scene, long], limits)

    count = len(alone.motion.motion_logits)
    torch.testing.assert_close(
        padded.motion.motion_logits[:count], alone.motion.motion_logits, **CLOSE
    )


def cut_short(scene, tokens):
    """The same scene, its log ending earlier."""
    per_token = {
        name: getattr(scene, name)[:, :tokens]
        for name in (
            "z_m",
            "pose",
            "motion_token",
            "presence",
            "observed",
            "pattern",
            "cell",
            "signal_state",
        )
    }
    kept = scene.insertion_token < tokens
    entries = {
        field.name: getattr(scene, field.name)[kept]
        for field in fields(scene)
        if field.name.startswith("insertion_")
    }
    return replace(scene, **per_token, **entries)


def test_what_comes_later_changes_no_logit(network, record, limits):
    scene = record(6, agents=12, tokens=10)
    early = cut_short(scene, 6)
    there = early.presence.any(axis=1)  # Others enter later: no rows of the short scene.

    whole, whole_out = run(network, [scene], limits)
    short, short_out = run(network, [early], limits)

    moves = whole_out.motion.rows.spread(whole_out.motion.motion_logits)[0, :6]
    cut_moves = short_out.motion.rows.spread(short_out.motion.motion_logits)[0]
    order = {tuple(p[0].tolist()): i for i, p in enumerate(_last_poses(whole))}
    for row, key in enumerate(_last_poses(short)):
        same = order[tuple(key[0].tolist())]
        torch.testing.assert_close(cut_moves[:, row], moves[:, same], **CLOSE)
    assert there.sum() == len(_last_poses(short))
    # At the last token of a log nobody is asked for.
    add = whole_out.entries.rows.spread(whole_out.entries.add_logit)[0, :5]
    cut_add = short_out.entries.rows.spread(short_out.entries.add_logit)[0, :5]
    slots = min(add.shape[1], cut_add.shape[1])
    torch.testing.assert_close(cut_add[:, :slots], add[:, :slots], **CLOSE)


def _last_poses(batch):
    """Sizes tell agents apart, whatever their order."""
    return [(size,) for size in batch.agents.size_lwh_m[0]]


@pytest.fixture(scope="module")
def crowded(record):
    """Three inserted agents at token 3, after three agents that are always there."""
    return record(8, tokens=6, lives=[(0, 5)] * 3 + [(3, 5)] * 3, spread_m=20.0)


def test_a_slot_sees_the_newcomers_before_it_and_not_those_after(network, crowded, limits):
    batch, before = run(network, [crowded], limits)
    assert batch.entries.count[0].tolist()[1:] == [0, 0, 3, 0, 0]
    second = int(batch.entries.agent[0, 3, 1])
    agents = batch.agents
    size_lwh_m = agents.size_lwh_m.clone()
    size_lwh_m[0, second] += 1.0
    changed = replace(batch, agents=replace(agents, size_lwh_m=size_lwh_m))

    with torch.no_grad():
        after = network(changed, hidden_roads=True)

    here = int(before.entries.rows.number[0, 3])
    gap = (
        (after.entries.position_logits - before.entries.position_logits)[here]
        .abs()
        .amax(-1)
    )
    assert gap[:2].max() == 0  # Slot 1 is asked for the second inserted agent itself.
    # Unlearned coordinates carry less of it before training: 5e-5 here.
    assert gap[2:].min() > (1e-5 if network.settings.relations == "rotary" else 1e-4)


def test_the_details_of_a_newcomer_do_not_show_the_newcomer(network, crowded, limits):
    batch, before = run(network, [crowded], limits)
    details, agents = batch.details, batch.agents
    newcomers = details.inserted[0].nonzero()[:, 0]
    row = int(newcomers[1])  # The second inserted agent: one before it, one after.
    moved = agents.pose.clone()
    for other in newcomers[1:]:
        moved[0, 3, details.agent[0, other], 2] += 1.0

    with torch.no_grad():
        after = network(replace(batch, agents=replace(agents, pose=moved)))

    at = int(before.details.rows.number[0, row])
    assert torch.equal(
        after.details.agent_type_logits[at], before.details.agent_type_logits[at]
    )
    assert torch.equal(after.details.heading_logits[at], before.details.heading_logits[at])


def test_pseudo_newcomers_do_not_see_themselves(network, record, limits):
    batch, before = run(network, [record(2, agents=8, tokens=5, spread_m=6.0)], limits)
    details, agents = batch.details, batch.agents
    row = int((~details.inserted[0] & details.present[0]).nonzero()[0])
    token, agent = int(details.token[0, row]), int(details.agent[0, row])
    pose = agents.pose.clone()
    pose[0, token, agent, 2] += 0.7

    with torch.no_grad():
        after = network(replace(batch, agents=replace(agents, pose=pose)))

    heading = before.details.heading_logits
    assert torch.equal(after.details.heading_logits[row], heading[row])
    assert not torch.equal(after.motion.motion_logits, before.motion.motion_logits)


def test_hidden_road_tokens_are_not_seen(network, record, limits):
    batch, before = run(network, [record(1)], limits)
    roads = batch.roads
    token = torch.where(roads.picked, (roads.token + 1) % 12, roads.token)
    pose = torch.where(roads.picked[..., None], roads.pose + 0.5, roads.pose)

    hidden = replace(roads, token=token, pose=pose)
    with torch.no_grad():
        covered = network.roads(hidden, network.roads.look(roads).covered(roads))
        logits, _ = network.roads.predict_hidden(hidden, covered)

    assert len(logits) >= 3
    assert torch.equal(logits, before.roads.logits)


def test_signals_as_they_were_last_are_seen(new_network, tiny, record, limits):
    network = new_network(replace(tiny, signals_each_step=False, signal_ahead_m=0.0)).eval()
    batch, before = run(network, [record(1)], limits)
    signal = (batch.roads.signal + 1) % 5

    with torch.no_grad():
        after = network(replace(batch, roads=replace(batch.roads, signal=signal)))

    assert (after.motion.motion_logits - before.motion.motion_logits).abs().max() > 1e-4


def test_a_light_that_changes_is_seen_from_then_on_and_not_before(network, record, limits):
    batch, before = run(network, [record(1)], limits)
    assert (batch.roads.light > 0).any()
    shown = batch.roads.shown.clone()
    shown[:, :, 4] = (shown[:, :, 4] + 1) % 5

    with torch.no_grad():
        after = network(replace(batch, roads=replace(batch.roads, shown=shown)))

    gap = before.motion.rows.spread(
        after.motion.motion_logits - before.motion.motion_logits
    )
    assert gap[0, :4].abs().max() == 0
    assert gap[0, 4].abs().max() > 1e-3


def test_agents_are_told_of_the_lines_ahead(network, record, limits):
    batch, told = run(network, [record(1)], limits)
    nowhere = torch.ones_like(batch.roads.follows)  # No lane begins: there are no lines.

    with torch.no_grad():
        untold = network(replace(batch, roads=replace(batch.roads, follows=nowhere)))

    gap = told.motion.motion_logits - untold.motion.motion_logits
    assert gap.abs().max() > 1e-3


def test_the_ego_alone_is_told_that_it_is(new_network, record, limits):
    network = new_network().eval()
    batch = collate([record(1, lives=[(0, 6)])], limits, 0)
    batch.agents.pose[:, :, 1] += 500  # Neither sees the other.

    with torch.no_grad():
        told = network(batch).motion.motion_logits
        network.embed.ego.zero_()
        untold = network(batch).motion.motion_logits
    ego, other = (told - untold).abs().amax(dim=-1).view(-1, 2).T

    assert ego.min() > 1e-3
    assert other.max() == 0


def test_an_agent_that_is_not_observed_is_neither_row_nor_neighbour(
    network, record, limits
):
    scene = record(1, lives=[(0, 6), (0, 6)])
    observed = scene.observed.copy()
    observed[1, 3] = False
    hidden = replace(scene, observed=observed)
    batch, before = run(network, [hidden], limits)
    gone = batch.agents.size_lwh_m[0, :, 0] == float(scene.size_lwh_m[1, 0])
    pose = batch.agents.pose.clone()
    pose[0, 3, gone, :2] += 3.0

    with torch.no_grad():
        after = network(replace(batch, agents=replace(batch.agents, pose=pose)))

    same = before.motion.rows.spread(before.motion.motion_logits)[0, :4]
    assert torch.equal(after.motion.rows.spread(after.motion.motion_logits)[0, :4], same)
    assert len(before.motion.motion_logits) == int(batch.agents.visible.sum())


@pytest.mark.parametrize(
    "shape",
    [
        {"tokens": 2},
        {"tokens": 1, "agents": 3},
        {"agents": 1},
        {"roads": 0},
        {"roads": 1, "agents": 1, "tokens": 2},
        {"kinds": (0, 1)},
        {"tokens": 39, "agents": 5},
    ],
)
def test_odd_scenes_work(network, record, limits, shape):
    batch, outputs = run(network, [record(4, **shape)], limits)

    assert batch.agents.pose.shape[1] == min(shape.get("tokens", 7), limits.tokens)
    for name, logits in all_logits(outputs).items():
        assert torch.isfinite(logits).all(), name


def test_sizes_follow_the_vocabularies(network, record, limits):
    _, outputs = run(network, [record(1)], limits)

    assert outputs.motion.motion_logits.shape[-1] == 24
    assert outputs.entries.position_logits.shape[-1] == network.grid.num_cells
    assert outputs.details.heading_logits.shape[-1] == 36
    assert outputs.roads.logits.shape[-1] == 12


def test_the_network_carries_its_codebooks(network, vocabularies):
    motion, roads = vocabularies()

    np.testing.assert_array_equal(network.motion_vocabulary().path, motion.path)
    np.testing.assert_array_equal(network.map_vocabulary().curve_m, roads.curve_m)


def test_every_parameter_is_used(new_network, record, limits):
    network = new_network()
    batch = collate([record(3, agents=12, tokens=9)], limits, 0)
    outputs = network(batch, hidden_roads=True)

    torch.stack([x.sum() for x in all_logits(outputs).values()]).sum().backward()

    assert [name for name, p in network.named_parameters() if p.grad is None] == []


def test_the_papers_sizes_make_about_eleven_million_parameters(vocabularies):
    network = Network(ModelSettings(), *vocabularies(2048, 1024), TokenSettings())

    assert 11e6 < sum(p.numel() for p in network.parameters()) < 12e6


def test_leaving_agents_are_there_to_be_seen(network, record, limits):
    scene = record(1, lives=[(0, 3), (0, 6)])
    batch, outputs = run(network, [scene], limits)

    leaving = batch.agents.presence == Presence.REMOVED
    assert leaving.sum() == 1
    assert outputs.motion.rows.number[leaving].tolist() != [0]
