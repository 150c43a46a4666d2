"""From tokenized scenes to padded tensors: what is taken, in which order, and when."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from infgen.config import TokenSettings, TrainSettings
from infgen.model.batching.batch import collate, collate_maps, to_device
from infgen.model.batching.crop import cut_window, hide_until_near
from infgen.model.batching.insertion_targets import OUTSIDE
from infgen.model.batching.padding import NO_AGENT
from infgen.model.batching.perturbation import make_perturbation
from infgen.tokens.grid import decode_cell, encode_cell, from_grid, make_grid, to_grid
from infgen.tokens.motion_tokens import advance, make_match_table, nearest_motion_tokens
from infgen.tokens.scene_tokens import (
    FIRST_MOTION_TOKEN,
    NO_CELL,
    NO_MOTION_TOKEN,
    Presence,
)
from infgen.tokens.signals import REMEMBERED


def parts(batch):
    return batch.agents, batch.roads, batch.entries, batch.details


def tensors(batch):
    for part in parts(batch):
        for field in fields(part):
            yield field.name, getattr(part, field.name)


def test_the_ego_is_first_and_the_others_come_from_near_to_far(record, limits):
    scene = record(0, agents=9)

    agents = collate([scene], limits, 0).agents

    assert torch.equal(agents.pose[0, :, 0], torch.from_numpy(scene.pose[0]))
    away_m = (agents.pose[0] - agents.pose[0, :, :1])[..., :2].norm(dim=-1)
    nearest_m = away_m.masked_fill(~agents.visible[0], torch.inf).amin(dim=0)
    assert (nearest_m.diff() >= 0).all()


def test_an_ego_in_another_row_is_first_all_the_same(record, limits):
    scene = record(0, agents=4, lives=[(0, 6)] * 3)

    agents = collate([replace(scene, ego=2)], limits, 0).agents

    assert torch.equal(agents.pose[0, :, 0], torch.from_numpy(scene.pose[2]))


def test_only_the_nearest_agents_are_kept_the_ego_always(record, limits):
    scene = record(0, agents=9)
    whole = collate([scene], limits, 0).agents

    few = collate([scene], replace(limits, agents=3), 0).agents

    assert few.agent_type.shape == (1, 3)
    assert torch.equal(few.pose, whole.pose[:, :, :3])


def test_newcomers_that_are_not_kept_are_not_asked_for(record, limits):
    scene = record(0, tokens=4, lives=[(0, 3), (2, 3)])

    entries = collate([scene], replace(limits, agents=1), 0).entries

    assert entries.count[0, 1:].sum() == 0


def test_only_the_roads_nearest_to_the_egos_path_are_kept_in_order(record, limits):
    scene = record(0, roads=60)

    roads = collate([scene], replace(limits, roads=10), 0).roads

    path = scene.pose[0, :, :2]
    away_m = np.linalg.norm(scene.map_pose[:, None, :2] - path, axis=-1).min(axis=1)
    kept = np.sort(np.argsort(away_m)[:10])
    assert torch.equal(roads.pose[0], torch.from_numpy(scene.map_pose[kept]))


def test_a_road_token_follows_the_one_before_it_on_the_same_line(record, limits):
    scene = record(0, roads=8)
    line = np.array([0, 0, 0, 1, 1, 2, 3, 3], dtype=np.int32)

    roads = collate([replace(scene, map_polyline=line)], limits, 0).roads

    assert roads.follows[0].tolist() == [False, True, True, False, True, False, False, True]


def test_padding_is_absent_and_unreal(record, limits):
    batch = collate(
        [record(0, agents=3, tokens=4, roads=10), record(1, agents=6, tokens=7)], limits, 0
    )

    assert not batch.agents.visible[0, 4:].any()
    assert not batch.agents.visible[0, :, 3:].any()
    assert (batch.agents.motion_token[0, 4:] == NO_MOTION_TOKEN).all()
    assert batch.roads.real.sum(dim=1).tolist() == [10, 60]
    assert not batch.entries.asked[0, 4:].any()


def test_patterns_are_those_of_the_scene_and_0_for_who_is_absent(record, limits):
    scene = record(3, agents=5, tokens=9, lives=[(0, 8)] * 4)
    part = cut_window(record(2, tokens=10, lives=LIVES), 3, 18, 99, 99)

    agents = collate([scene, record(4)], limits, 0).agents

    assert torch.equal(agents.pattern[0, :, 0], torch.from_numpy(scene.pattern[0]).long())
    assert (agents.pattern[agents.presence == Presence.ABSENT] == 0).all()
    assert (part.pattern[part.presence == Presence.ABSENT] == 0).all()
    assert part.pattern.any()


def test_moves_are_learned_as_they_were_made(record, limits):
    agents = collate([record(3, agents=12, tokens=9), record(4)], limits, 0).agents

    assert torch.equal(agents.label, agents.motion_token)


def test_newcomers_take_turns_from_near_to_far(record, limits):
    scene = record(8, tokens=5, lives=[(0, 4), (2, 4), (2, 4), (3, 4)], spread_m=20.0)

    batch = collate([scene], limits, 0)

    entries, agents = batch.entries, batch.agents
    assert entries.asked[0].tolist() == [False, True, True, True, False]
    assert entries.count[0, 1:].tolist() == [0, 2, 1, 0]
    first, second = entries.agent[0, 2, :2].tolist()
    away_m = (agents.pose[0, 2] - agents.pose[0, 2, 0])[:, :2].norm(dim=-1)
    assert away_m[first] < away_m[second]
    assert agents.turn[0, 2, [first, second]].tolist() == [0, 1]
    assert entries.cell[0, 2, 0] == agents.cell[0, 2, first]
    assert entries.agent[0, 1].tolist() == [NO_AGENT] * entries.agent.shape[2]


def test_all_others_have_no_turn_and_those_outside_the_grid_an_endless_one(record, limits):
    scene = record(8, tokens=4, lives=[(0, 3), (2, 3)], spread_m=20.0)
    far = replace(
        scene,
        insertion_cell=np.where(
            scene.insertion_agent == 2, -1, scene.insertion_cell
        ).astype("i2"),
    )

    turn = collate([far], limits, 0).agents.turn[0]

    assert turn[3].tolist() == [-1, -1, -1]
    assert turn[2, 1:].sort().values.tolist() == [-1, OUTSIDE]
    assert turn[:, 0].tolist() == [-1] * 4


@pytest.mark.parametrize("disturbed", [False, True])
def test_details_decode_to_where_the_agent_is(
    record, limits, grid_settings, noise, disturbed
):
    scene = record(3, agents=12, tokens=9)
    batch = collate([scene], limits, 0, noise if disturbed else None)
    details, agents = batch.details, batch.agents
    grid = make_grid(grid_settings)

    for row in details.present[0].nonzero()[:, 0].tolist():
        token, agent = int(details.token[0, row]), int(details.agent[0, row])
        cell = np.int16(details.cell[0, row])
        ego_pose = agents.pose[0, token, 0].numpy()
        in_grid_m = decode_cell(np.asarray(cell), grid) + details.offset_m[0, row].numpy()
        pose = agents.pose[0, token, agent].numpy()
        np.testing.assert_allclose(from_grid(in_grid_m, ego_pose), pose[:2], atol=1e-3)
        turned_rad = (
            pose[2] - ego_pose[2] - grid.heading_centre_rad[details.heading[0, row]]
        )
        assert abs((turned_rad + np.pi) % (2 * np.pi) - np.pi) < np.radians(5.001)


@pytest.fixture(scope="module")
def noise(vocabularies):
    return make_perturbation(
        TrainSettings(motion_noise_neighbours=6, map_noise_neighbours=4), *vocabularies()
    )


def with_a_gap(scene):
    """The scene with row 1 unseen for two tokens, then going on."""
    observed, motion_token = scene.observed.copy(), scene.motion_token.copy()
    observed[1, 3:5], motion_token[1, 3:5] = False, NO_MOTION_TOKEN
    return replace(scene, observed=observed, motion_token=motion_token)


@pytest.fixture(scope="module")
def pair(record, limits, noise):
    """The same three scenes as they are and disturbed."""
    lives = [(0, 8), (0, 8), (3, 8), (2, 6), (0, 5), (5, 8)]
    scenes = [record(3, tokens=9, lives=lives), record(4, agents=14), record(5)]
    scenes[0] = with_a_gap(scenes[0])
    return collate(scenes, limits, 7), collate(scenes, limits, 7, noise)


def test_noise_without_a_choice_leaves_a_batch_as_it_is(record, limits, vocabularies):
    scenes = [with_a_gap(record(3, agents=12, tokens=9)), record(4)]
    none = make_perturbation(
        TrainSettings(motion_noise_neighbours=1, map_noise_neighbours=1), *vocabularies()
    )

    plain, noisy = collate(scenes, limits, 7), collate(scenes, limits, 7, none)

    for (name, one), (_, two) in zip(tensors(plain), tensors(noisy), strict=True):
        assert torch.equal(one, two), name


def test_noise_changes_only_what_agents_do_and_where_they_are(pair):
    plain, noisy = pair

    changed = {
        f"{type(part).__name__}.{field.name}"
        for part, other in zip(parts(plain), parts(noisy), strict=True)
        for field in fields(part)
        if not torch.equal(getattr(part, field.name), getattr(other, field.name))
    }
    told = {f"Details.{name}" for name in ("cell", "heading", "offset_m", "offset")}
    told.add("Insertions.cell")
    asked = {"Details.agent", "Details.token", "Details.agent_type", "Details.size_lwh_m"}
    asked |= {f"Details.{name}" for name in ("present", "inserted", "turn")}
    agents = {"Agents.pose", "Agents.motion_token", "Agents.label", "Agents.cell"}
    assert agents | {"Details.offset_m", "MapTokens.token"} <= changed
    assert changed <= agents | told | asked | {"MapTokens.token"}


def test_agents_that_noise_led_astray_are_no_pseudo_insertions(pair):
    plain, noisy = pair
    details = noisy.details
    pseudo = details.present & ~details.inserted

    scene, place = pseudo.nonzero(as_tuple=True)
    at = scene, details.token[scene, place], details.agent[scene, place]
    here, logged = noisy.agents.pose[at], plain.agents.pose[at]

    assert 0 < len(scene) <= (plain.details.present & ~plain.details.inserted).sum()
    assert torch.equal(here, logged)


def test_noise_moves_the_ego_but_nobody_who_is_absent_entering_or_unseen(pair):
    plain, noisy = pair
    still = ~plain.agents.observed
    ego = plain.agents.observed[:, :, 0]

    for name in ("pose", "motion_token", "label"):
        one, two = getattr(plain.agents, name), getattr(noisy.agents, name)
        assert torch.equal(one[still], two[still]), name
        assert not torch.equal(one[:, :, 0][ego], two[:, :, 0][ego]), name
    assert (plain.agents.presence[still] == Presence.PRESENT).any()  # The gap.


def test_noisy_agents_go_where_their_moves_lead_and_learn_to_come_back(pair, vocabularies):
    plain, noisy = pair
    vocabulary, _ = vocabularies()
    table = make_match_table(vocabulary)
    scene, token, row = noisy.agents.observed.nonzero(as_tuple=True)
    agent_type = noisy.agents.agent_type[scene, row].numpy().astype(np.int8)
    before = noisy.agents.pose[scene, token - 1, row].numpy()
    wanted = plain.agents.pose[scene, token, row].numpy()

    motion_token = noisy.agents.motion_token[scene, token, row].numpy().astype(np.int16)
    ends = advance(before, agent_type, motion_token, vocabulary)
    label = nearest_motion_tokens(wanted, before, agent_type, table)

    np.testing.assert_allclose(noisy.agents.pose[scene, token, row], ends, atol=1e-4)
    np.testing.assert_array_equal(noisy.agents.label[scene, token, row].numpy(), label)


def test_noisy_agents_are_in_the_cells_they_are_in(pair, grid_settings):
    agents = pair[1].agents
    grid = make_grid(grid_settings)
    in_grid_m = to_grid(agents.pose[..., :2].numpy(), agents.pose[:, :, :1].numpy())

    cell = torch.from_numpy(encode_cell(in_grid_m, grid)).long()

    assert torch.equal(agents.cell[agents.observed], cell[agents.observed])


def test_noise_loses_no_newcomer_and_puts_each_in_its_cell_of_the_ego_as_it_is(
    pair, grid_settings
):
    plain, noisy = pair
    came = noisy.entries.agent != NO_AGENT
    scene, token, _ = came.nonzero(as_tuple=True)
    agent = noisy.entries.agent[came]
    pose, ego_pose = (noisy.agents.pose[scene, token, row] for row in (agent, 0))

    in_grid_m = to_grid(pose[..., :2].numpy(), ego_pose.numpy())
    cell = torch.from_numpy(encode_cell(in_grid_m, make_grid(grid_settings))).long()

    assert torch.equal(plain.entries.agent, noisy.entries.agent)
    assert torch.equal(noisy.entries.cell[came], cell)
    assert torch.equal(noisy.agents.cell[scene, token, agent], cell)
    assert not torch.equal(ego_pose, plain.agents.pose[scene, token, 0])


def test_noise_draws_what_is_its_own_and_by_draw_and_scene(record, limits, noise):
    scenes = [record(3, agents=12, tokens=9), record(4)]

    one, two = (collate(scenes, limits, 7, noise) for _ in range(2))
    alone, other = collate(scenes[1:], limits, 7, noise), collate(scenes, limits, 8, noise)
    plain = collate(scenes, limits, 7)

    pairs = zip(tensors(one), tensors(two), strict=True)
    assert all(torch.equal(a, b) for (_, a), (_, b) in pairs)
    own = alone.agents.motion_token[0]
    assert torch.equal(own, one.agents.motion_token[1, : own.shape[0], : own.shape[1]])
    assert not torch.equal(one.agents.motion_token, other.agents.motion_token)
    assert torch.equal(one.roads.picked, plain.roads.picked)


def test_road_tokens_to_predict_are_never_disturbed(pair):
    plain, noisy = pair
    changed = plain.roads.token != noisy.roads.token

    assert changed.any()
    assert not changed[plain.roads.picked].any()


def test_those_who_play_newcomers_are_there_already_and_not_the_ego(record, limits):
    batch = collate([record(3, agents=12, tokens=9)], limits, 0)
    details, agents = batch.details, batch.agents
    players = details.present & ~details.inserted

    assert players.sum() == 16  # Two per token.
    scene, row = players.nonzero(as_tuple=True)
    token, agent = details.token[scene, row], details.agent[scene, row]
    assert (agents.presence[scene, token, agent] == Presence.PRESENT).all()
    assert (agent > 0).all()
    assert (token > 0).all()
    assert (details.turn[scene, row] == 0).all()


def test_equal_draws_make_equal_batches_and_others_others(record, limits):
    scenes = [record(3, agents=12, tokens=9), record(4)]

    same = zip(
        tensors(collate(scenes, limits, 7)),
        tensors(collate(scenes, limits, 7)),
        strict=True,
    )
    other = collate(scenes, limits, 8)

    assert all(torch.equal(one, two) for (_, one), (_, two) in same)
    assert not torch.equal(other.roads.picked, collate(scenes, limits, 7).roads.picked)


def test_a_scenes_draw_does_not_depend_on_its_batch(record, limits):
    scene, more = record(3, agents=12, tokens=9), record(4)

    alone, together = collate([scene], limits, 7), collate([more, scene], limits, 7)

    assert torch.equal(alone.roads.picked[0], together.roads.picked[1])


def test_long_logs_give_a_part_that_depends_on_the_draw(record, limits):
    scene = record(3, agents=5, tokens=39)

    starts = set()
    for draw in range(20):
        pose = collate([scene], limits, draw).agents.pose[0, :, 0]
        assert len(pose) == 18
        gap_m = np.abs(scene.pose[0] - pose[0].numpy()).sum(axis=-1)
        starts.add(int(gap_m.argmin()))
    assert len(starts) > 8
    assert min(starts) >= 0
    assert max(starts) <= 21


LIVES = [(0, 9), (3, 9), (0, 4), (0, 2), (5, 9), (0, 3)]


@pytest.fixture
def window(record):
    scene = record(2, tokens=10, lives=LIVES)
    return scene, cut_window(scene, 3, 18, 99, 99)


def row_in(window, scene, row):
    return int(np.flatnonzero(window.size_lwh_m[:, 0] == scene.size_lwh_m[row, 0])[0])


def test_who_is_there_when_a_window_begins_enters_then(window):
    scene, part = window
    row = row_in(part, scene, 1)

    assert part.presence[row, 0] == Presence.INSERTED
    assert part.motion_token[row, 0] == FIRST_MOTION_TOKEN
    assert not part.observed[row, 0]
    assert (part.presence[row, 1:] == Presence.PRESENT).all()
    np.testing.assert_array_equal(part.pose[row], scene.pose[1, 3:])


def test_who_leaves_as_a_window_begins_or_before_is_not_in_it(window):
    scene, part = window
    sizes = part.size_lwh_m[:, 0]

    assert scene.size_lwh_m[4, 0] not in sizes  # Left before.
    assert scene.size_lwh_m[6, 0] not in sizes  # Leaves at its first token.
    assert scene.size_lwh_m[3, 0] in sizes  # Leaves one token later.
    assert len(sizes) == 5


def test_newcomers_of_a_window_keep_their_tokens_less_its_start(window):
    scene, part = window
    entered = dict(zip(part.entry_row.tolist(), part.insertion_token.tolist(), strict=True))

    assert entered == {row_in(part, scene, 2): 0, row_in(part, scene, 5): 2}


def test_who_is_in_a_gap_when_a_window_begins_enters_after_it(record):
    scene = record(2, tokens=10, lives=[(0, 9)])
    observed = scene.observed.copy()
    observed[1, 2:5] = False

    part = cut_window(replace(scene, observed=observed), 3, 18, 99, 99)

    wanted = [Presence.ABSENT] * 2 + [Presence.INSERTED] + [Presence.PRESENT] * 4
    assert part.presence[1].tolist() == wanted


@pytest.fixture
def coming(record):
    """Window of agents beyond 40 m at first: one nears, one never, one leaves as it does.

    A fourth comes near with the third token, which begins as the history ends.
    """
    scene = record(2, tokens=8, lives=[(0, 7), (0, 7), (0, 3), (2, 7)])
    pose = np.zeros_like(scene.pose)
    pose[1:, :, 0] = 50.0
    pose[1:3, :, 1] = np.array([[0.0], [9.0]])
    pose[[1, 3], 2:, 0] = 30.0
    pose[4, :, 0] = np.linspace(54.0, 33.0, 8)
    grid = make_grid(TokenSettings())
    cell = encode_cell(to_grid(pose[..., :2], pose[:1]), grid)
    cell = np.where(scene.presence == Presence.ABSENT, NO_CELL, cell)
    scene = replace(scene, pose=pose, cell=cell.astype(np.int16))
    return scene, cut_window(scene, 0, 8, 99, 99)


def hidden(coming, known=2, enter_m=40.0):
    scene, part = coming
    settings = TokenSettings(insertion_distance_m=enter_m)
    part = hide_until_near(part, settings, known)
    rows = [row_in(part, scene, row) for row in range(1, len(scene.pose))]
    return part, rows


def test_who_is_beyond_the_rim_at_first_enters_once_it_has_come_within(coming):
    part, (near, never, leaver, late) = hidden(coming)

    # Within at the end of token 2, so observed within from token 3 on.
    assert part.presence[near].tolist() == [0, 0, 0, 2, 1, 1, 1, 1]
    assert part.observed[near].tolist() == [False] * 4 + [True] * 4
    assert part.motion_token[near, 3] == part.label[near, 3] == FIRST_MOTION_TOKEN
    assert not part.presence[never].any()
    assert not part.presence[leaver].any()  # It would enter as it leaves.
    assert part.presence[late].tolist() == [0] * 6 + [2, 1]
    assert (part.pattern[part.presence == Presence.ABSENT] == 0).all()
    assert (part.presence[0] == coming[1].presence[0]).all()


def test_entries_are_listed_where_they_now_are(coming):
    part, (near, _, _, late) = hidden(coming)

    listed = list(zip(part.insertion_token.tolist(), part.entry_row.tolist(), strict=True))

    assert listed == [(0, 0), (3, near), (6, late)]
    np.testing.assert_array_equal(
        part.insertion_cell, part.cell[part.entry_row, part.insertion_token]
    )


@pytest.mark.parametrize(("known", "enter_m"), [(2, 0.0), (2, 60.0), (0, 40.0)])
def test_nobody_is_hidden_without_a_rim_or_within_it_or_after_the_history(
    coming, known, enter_m
):
    part, _ = hidden(coming, known, enter_m)

    for name in ("presence", "observed", "motion_token", "label", "pattern", "entry_row"):
        np.testing.assert_array_equal(getattr(part, name), getattr(coming[1], name))


def test_in_half_of_the_scenes_the_rim_is_bare(coming, limits):
    rimmed = replace(limits, grid=TokenSettings(insertion_distance_m=40.0))

    bare = [
        not collate([coming[0]], rimmed, draw).agents.visible[0, 0, 1:].any()
        for draw in range(64)
    ]

    assert 20 < sum(bare) < 44


def test_maps_alone_are_whole_and_hide_nothing(record):
    scenes = [record(0, roads=7), record(1, roads=5)]

    roads = collate_maps(scenes, 100)

    assert roads.real.sum(dim=1).tolist() == [7, 5]
    assert not roads.picked.any()


def test_lights_of_maps_alone_are_seen_as_long_as_they_are_known_then_remembered(record):
    scenes = [record(0, tokens=7), record(1, tokens=9)]

    shown = collate_maps(scenes, 100).shown.numpy()

    for at, scene in enumerate(scenes):
        state = scene.signal_state
        lights, tokens = state.shape
        assert lights
        np.testing.assert_array_equal(shown[at, :lights, :tokens], state)
        assert (state[:, -1] + REMEMBERED == shown[at, :lights, tokens:].T).all()


def test_in_half_of_the_scenes_nobody_looks_at_lights_after_the_history(record, limits):
    scene = record(1)
    state, now = scene.signal_state, scene.now

    batches = [collate([scene], limits, draw).roads.shown[0].numpy() for draw in range(40)]

    looked = [np.array_equal(shown, state) for shown in batches]
    assert 12 < sum(looked) < 28
    for shown in (shown for shown, seen in zip(batches, looked, strict=True) if not seen):
        np.testing.assert_array_equal(shown[:, : now + 1], state[:, : now + 1])
        assert (state[:, now] + REMEMBERED == shown[:, now + 1 :].T).all()


def test_batches_move_whole(record, limits):
    batch = collate([record(0)], limits, 0)

    moved = to_device(batch, torch.device("meta"))

    assert moved.scenario_ids == batch.scenario_ids
    assert all(tensor.device.type == "meta" for _, tensor in tensors(moved))
