"""Every variant of the network is played, and what must always hold holds."""

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from infgen.geometry import boxes_overlap
from infgen.metrics.long_term.radius import present_within_radius
from infgen.rollout.population import EGO_ROW
from infgen.rollout.recording import NO_AGENT, collect
from infgen.rollout.rollout import NEVER
from infgen.rollout.session import Session
from infgen.rollout.simulate import simulate
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import Presence
from tests.rollout.single_rules import only

VARIANTS = {
    "full": {},
    "smart": {"insertion_and_removal": False},
    "no leave token": {"remove_token": False},
    "no cell token": {"position_token": False},
    "no heading token": {"heading_token": False},
    "no leave, no cell token": {"remove_token": False, "position_token": False},
    "offset token": {"offset_token": True, "cell_feature_width": 4},
    "patterns": {"validity_pattern_tokens": True},
    "rotary": {"relations": "rotary"},
    "ego features": {"ego_features": True, "standing_features": True},
    "latent rates": {"latent_rates": True},
    "cell refinement": {"cell_feature_width": 4, "cell_refinement_width": 4},
    "agent spacing": {
        "agent_spacing_width": 4,
        "offset_token": True,
        "placement_features": True,
    },
    "last move": {"last_move_head": True, "over_edge_head": True},
    "clearance": {"clearance_width": 4, "edge_clearance_width": 4},
}
FASTEST_M = 20.0
"""The longest move of the vocabulary of these tests."""


def play(simulator, starts):
    return collect(starts, list(simulate(simulator, starts)), "weights")


def check_session(session, frames, grid):
    """What must hold of every frame of a session, and between frames."""
    gone, ids = set(), set()
    for _ in range(frames):
        before = session.population
        frame = session.step()
        after = session.population
        lives = {
            (r, n) for r, row in enumerate(frame.agent_number) for n in row if n != NO_AGENT
        }
        rows = (frame.agent_number != NO_AGENT).sum()
        assert len(lives) == rows, "an agent has one row"
        assert not lives & gone, "who has left never returns"
        same = (before.agent_number == frame.agent_number) & (
            frame.agent_number != NO_AGENT
        )
        assert same.sum() == rows, "who is there was there, in the same row"
        gap_m = np.linalg.norm(frame.path[:, :, -1, :2] - before.pose[..., :2], axis=-1)
        assert gap_m[same].max() <= FASTEST_M + 1e-3
        gone |= {(r, frame.agent_number[r, row]) for r, row in np.argwhere(frame.removed)}
        inserted_number = {
            (r, frame.inserted_number[r, row])
            for r, row in np.argwhere(frame.inserted_number != NO_AGENT)
        }
        assert not inserted_number & (ids | lives), "every newcomer is a new agent"
        ids |= lives | inserted_number
        entering = after.presence == Presence.INSERTED
        assert (after.cells(grid)[entering] >= 0).all(), "newcomers are in the grid"
        assert (after.presence[:, EGO_ROW] == Presence.PRESENT).all()
    return ids


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_plays_and_keeps_the_rules(
    variant, crossing, parked, start, simulator, force
):
    playing = simulator(
        VARIANTS[variant],
        **only(insertion_mask=True, max_insertion_attempts=2),
        max_agents=9,
        max_insertions=2,
        removal_radius_m=80.0,
    )
    add = 1.0 if playing.stepper.insertion_and_removal else None
    force(playing, add=add, leave=-1.0 if playing.stepper.leaves else None)
    session = Session(playing, [start(crossing()), start(parked(4))])

    ids = check_session(session, 5, playing.grid)

    inserted = len(ids) - (3 + 5)
    assert inserted > 3 if playing.stepper.insertion_and_removal else inserted == 0


@settings(
    max_examples=5,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    add=st.floats(-2, 4),
    leave=st.floats(-4, 2),
    rows=st.integers(5, 9),
    index=st.integers(0, 1000),
    mask=st.booleans(),
)
def test_the_rules_hold_whatever_comes_and_goes(
    crossing, start, simulator, force, add, leave, rows, index, mask
):
    playing = simulator(
        max_agents=rows,
        **only(insertion_mask=mask),
        max_insertions=3,
        motion_top_k=0,
        position_top_k=0,
    )
    force(playing, add=add, leave=leave)
    session = Session(playing, start(crossing(), index))

    check_session(session, 5, playing.grid)

    assert session.population.agent_number.shape == (1, rows)


def test_rows_that_are_freed_are_used_again(crossing, start, simulator, force):
    playing = simulator(max_agents=5, max_insertions=2)
    force(playing, add=20.0, leave=2.0)
    session = Session(playing, start(crossing()))

    ids = check_session(session, 12, playing.grid)

    assert len(ids) > 2 * 5


def test_motion_only_weights_say_what_they_play_and_ignore_the_rest(
    crossing, start, simulator
):
    playing = simulator({"insertion_and_removal": False}, insert=True, remove=True)

    (rollout,) = play(playing, [start(crossing())])

    assert playing.simulates == "motion only"
    assert rollout.logged.all()
    assert (rollout.exit_step == NEVER).all()
    assert simulator().simulates == "motion, entries, exits"
    assert simulator({"remove_token": False}).simulates == "motion, entries"
    assert simulator(mode="wosac", seconds=None).simulates == "motion only"


@pytest.fixture
def passing(build_scene, start):
    """The ego stands; one car drives away from 20 m, one comes from 140 m, one is near."""
    away_m = np.arange(91) * 1.0
    path = np.zeros((4, 91, 3))
    path[1, :, 0], path[2, :, 0], path[3, :, 1] = 20 + away_m, 140 - away_m, 10
    path[2, :, 2] = np.pi
    return start(build_scene(path, [0] * 4))


def test_smart_with_the_radius_heuristic_enters_and_leaves_as_the_paper_says(
    passing, simulator
):
    playing = simulator(VARIANTS["smart"], seconds=8.0)
    keep_speed(playing)
    (rollout,) = play(playing, [passing])

    found = present_within_radius(rollout, radius_m=80.0)

    # At ends of token steps 20 + 65 m is the first beyond, 140 - 60 m the first within.
    np.testing.assert_array_equal(found.exit_step, [NEVER, 60, NEVER, NEVER])
    np.testing.assert_array_equal(found.entry_step, [0, 0, 60, 0])
    assert not found.valid[2, :61].any()
    assert found.valid[2, 61:].all()
    assert not found.valid[1, 61:].any()


@pytest.mark.parametrize("variant", ["smart", "no leave token"])
def test_without_leave_tokens_agents_leave_by_distance_alone(variant, passing, simulator):
    playing = simulator(VARIANTS[variant], seconds=4.0, insert=False, removal_radius_m=60.0)
    keep_speed(playing)

    (rollout,) = play(playing, [passing])

    # Beyond 60 m for the first time at the end of a half second at step 45 (65 m).
    np.testing.assert_array_equal(rollout.exit_step, [NEVER, 45, NEVER, NEVER])
    (stays,) = play(simulator(VARIANTS[variant], seconds=1.0, insert=False), [passing])
    assert (stays.exit_step == NEVER).all()


def keep_speed(playing):
    """Let everyone repeat the move that led to where it is."""
    step = playing.stepper.motion_step

    def again(memory, token_step, rows):
        said = step(memory, token_step, rows)
        wanted = torch.nn.functional.one_hot(
            token_step.motion_token.clamp(min=0), 61
        ).float()
        said.packed.motion_logits.copy_(100 * said.packed.rows.pack(wanted))
        return said

    playing.stepper.motion_step = again


def test_newcomers_are_kept_off_others_and_near_lanes(parked, start, simulator, force):
    playing = simulator(
        **only(
            insertion_mask=True, insertion_lane_distance_m=6.0, max_insertion_attempts=5
        ),
        position_top_k=0,
        max_agents=40,
        max_insertions=5,
    )
    force(playing, add=3.0, leave=-20.0)
    session = Session(playing, [start(parked(6), at) for at in range(4)])
    entered = vehicles = 0
    for _ in range(3):
        session.step()
        now = session.population
        entering = now.presence == Presence.INSERTED
        entered += entering.sum()
        vehicles += (entering & (now.agent_type == AgentType.VEHICLE)).sum()
        for rollout, row in np.argwhere(entering):
            assert_has_room(now, rollout, row)
    assert entered > 20
    assert vehicles > 3


def assert_has_room(now, rollout, row):
    others = (now.presence[rollout] != Presence.ABSENT) & (
        np.arange(now.agent_number.shape[1]) != row
    )
    if now.agent_type[rollout, row] == AgentType.PEDESTRIAN:
        others &= now.agent_type[rollout] != AgentType.PEDESTRIAN
    elif now.agent_type[rollout, row] == AgentType.VEHICLE:
        assert abs(now.pose[rollout, row, 1]) < 6.1, "the lane is y = 0"
    overlap = boxes_overlap(
        now.pose[rollout, row][None],
        now.size_lwh_m[rollout, row, :2],
        now.pose[rollout, others],
        now.size_lwh_m[rollout, others, :2],
    )
    assert not overlap.any()


def test_with_a_mask_that_refuses_nobody_rollouts_are_as_without(
    crossing, start, simulator
):
    scene = crossing()

    few = {"seconds": 2.0, "max_insertions": 2}
    (masked,) = play(
        simulator(
            **few,
            **only(
                insertion_mask=True,
                insertion_lane_distance_m=1e6,
                max_insertion_attempts=1,
            ),
        ),
        [start(scene)],
    )
    (free,) = play(simulator(**few), [start(scene)])

    same = min(len(masked.id), len(free.id))
    first = int(np.argmax(masked.entry_step[:same] != free.entry_step[:same]) or same)
    steps = int(masked.entry_step[first]) if first < same else masked.num_steps
    np.testing.assert_array_equal(masked.xyz_m[:3, :steps], free.xyz_m[:3, :steps])


def test_patterns_make_agents_flicker_and_nothing_else(crossing, start, simulator, force):
    model = {"validity_pattern_tokens": True}
    seen, flickering = (
        simulator(model, validity_patterns=patterns, max_insertions=2, seconds=3.0)
        for patterns in (False, True)
    )
    for playing in (seen, flickering):
        force(playing, add=0.0, leave=-2.0)
    begin = start(crossing())

    (steady,), (rollout,) = play(seen, [begin]), play(flickering, [begin])

    np.testing.assert_array_equal(rollout.id, steady.id)
    np.testing.assert_array_equal(rollout.exit_step, steady.exit_step)
    assert not (rollout.valid & ~steady.valid).any()
    assert rollout.valid[:, 11:].sum() < 0.8 * steady.valid[:, 11:].sum()
    shown = rollout.valid
    np.testing.assert_array_equal(rollout.xyz_m[shown], steady.xyz_m[shown])
    assert not rollout.xyz_m[~shown].any()
    assert shown[rollout.ego].all()
    left = rollout.exit_step != NEVER
    assert shown[left, rollout.exit_step[left]].all()
    later = ~rollout.logged & (rollout.entry_step < rollout.num_steps - 1)
    assert later.any()
    assert shown[later, rollout.entry_step[later] + 1].all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("add_bias", -30.0),
        ("add_bias", 30.0),
        ("remove_bias", 30.0),
        ("remove_bias", -30.0),
    ],
)
def test_biases_decide_where_the_network_is_undecided(
    crossing, start, simulator, name, value
):
    kept = {"add_bias": -30.0, "remove_bias": -30.0, name: value}

    (rollout,) = play(simulator(seconds=1.0, max_insertions=2, **kept), [start(crossing())])

    assert (~rollout.logged).any() == (kept["add_bias"] > 0)
    assert (rollout.exit_step != NEVER).any() == (kept["remove_bias"] > 0)


def test_the_likeliest_alone_is_what_every_seed_plays(crossing, start, simulator):
    scene = crossing()
    few = {"insert": False, "remove": False, "seconds": 1.0}
    certain = simulator(motion_top_k=1, **few)
    cold = simulator(motion_top_k=0, motion_temperature=1e-6, **few)

    one, other = play(certain, [start(scene, 0), start(scene, 1)])

    np.testing.assert_array_equal(one.xyz_m, other.xyz_m)
    (same,) = play(cold, [start(scene, 2)])
    np.testing.assert_allclose(same.xyz_m, one.xyz_m, atol=1e-4)


def test_a_narrow_nucleus_leaves_the_likeliest_way_to_go_and_to_stand(
    crossing, start, simulator
):
    few = {"insert": False, "remove": False, "seconds": 0.5, "motion_top_k": 0}
    playing = simulator(motion_top_p=1e-6, **few)

    ends_m = [
        play(playing, [start(crossing(), seed)])[0].xyz_m[:, -1] for seed in range(12)
    ]

    for each in np.swapaxes(ends_m, 0, 1):
        assert len(np.unique(each.round(3), axis=0)) <= 2
