import dataclasses

import numpy as np
import pytest

from infgen.config import TokenSettings
from infgen.scene import SignalState
from infgen.tokens.scene_tokens import Presence, SignalClass
from infgen.tokens.tokenizer import tokenize_scene
from infgen.tokens.tracks import TokensError

SETTINGS = TokenSettings()
ARRAYS = (
    "agent_type",
    "pose",
    "motion_token",
    "presence",
    "observed",
    "cell",
    "size_lwh_m",
    "near",
)


@pytest.fixture
def tokens_of(metre_moves, bent_roads):
    def run(scene, settings=SETTINGS, **more):
        return tokenize_scene(scene, metre_moves, bent_roads, settings, **more)

    return run


def beside(build_scene, *spans, now=10, **more):
    """The ego, and one car beside it per list of spans at which it is known."""
    x_m = np.arange(91.0)
    rows = [
        np.column_stack([x_m, 0 * x_m + 4 * row, 0 * x_m]) for row in range(1 + len(spans))
    ]
    valid = np.zeros((len(rows), 91), bool)
    valid[0] = True
    for row, known in enumerate(spans, start=1):
        for first, end in known:
            valid[row, first:end] = True
    return build_scene(np.stack(rows), [0] * len(rows), valid, now=now, **more)


def test_a_scene_keeps_its_names_and_counts(tokens_of, crossing):
    tokens = tokens_of(crossing())

    assert tokens.scenario_id == "made-by-hand"
    assert (tokens.now, tokens.ego) == (1, 0)
    assert tokens.track_id.tolist() == [100, 101, 102, 103]
    assert (tokens.num_agents, tokens.num_tokens) == (4, 18)
    np.testing.assert_allclose(tokens.size_lwh_m[2], [1.0, 1.0, 1.7])
    np.testing.assert_allclose(tokens.z_m[0], 0.8)


def test_tracks_without_a_move_are_dropped_unless_they_are_there_now(
    tokens_of, build_scene
):
    scene = beside(
        build_scene,
        [(20, 41)],  # four tokens
        [(40, 46)],  # one token
        [(40, 44)],  # none
        [(20, 26), (60, 66)],  # two tokens, not in a row
        [(10, 12)],  # there now
        [],
    )

    assert tokens_of(scene).track_id.tolist() == [100, 101, 105]


def test_the_ego_is_kept_even_if_the_log_has_one_token(tokens_of, drive):
    tokens = tokens_of(drive(steps=6, now=5))

    assert tokens.presence.tolist() == [[Presence.INSERTED]]


def test_a_history_has_the_tokens_up_to_now_of_those_there_now(tokens_of, build_scene):
    scene = beside(
        build_scene,
        [(0, 91)],
        [(0, 9)],  # gone before now
        [(10, 91)],  # appears now
        [(11, 91)],  # comes later
        [(0, 11)],  # gone after now
        [(7, 11)],
    )

    history = tokens_of(scene, until=10)

    assert history.num_tokens == 2
    assert history.track_id.tolist() == [100, 101, 103, 105, 106]
    enter, here, absent = Presence.INSERTED, Presence.PRESENT, Presence.ABSENT
    expected = [
        [enter, here],
        [enter, here],
        [absent, enter],
        [enter, here],
        [absent, enter],
    ]
    np.testing.assert_array_equal(history.presence, expected)


def test_a_history_does_not_know_the_future(tokens_of, crossing, build_signals):
    """Whatever happens after now, the history is the same bytes."""
    rng = np.random.default_rng(0)
    lights = [(step, 1, SignalState.STOP) for step in range(11)]
    scene = crossing(signals=build_signals(lights))
    tracks, later = scene.tracks, slice(11, None)
    wild = {}
    for name in ("xyz_m", "heading_rad", "velocity_mps", "size_lwh_m"):
        wild[name] = getattr(tracks, name).copy()
        wild[name][:, later] = rng.normal(size=wild[name][:, later].shape)
    valid = tracks.valid.copy()
    valid[:, later] = rng.random(valid[:, later].shape) < 0.5
    changed = dataclasses.replace(
        scene,
        tracks=dataclasses.replace(tracks, valid=valid, **wild),
        signals=build_signals([*lights, (12, 1, SignalState.GO), (20, 2, SignalState.GO)]),
    )

    one, two = tokens_of(scene, until=10), tokens_of(changed, until=10)

    for field in dataclasses.fields(one):
        np.testing.assert_array_equal(
            getattr(one, field.name), getattr(two, field.name), err_msg=field.name
        )


def test_a_history_is_the_start_of_the_whole_log(tokens_of, crossing):
    whole, history = tokens_of(crossing()), tokens_of(crossing(), until=10)

    rows = np.searchsorted(whole.track_id, history.track_id)
    for name in ("pose", "motion_token", "cell", "presence", "observed"):
        np.testing.assert_array_equal(
            getattr(history, name), getattr(whole, name)[rows, :2], err_msg=name
        )


def test_nobody_is_too_far_for_a_simulation_that_asks_so(tokens_of, build_scene):
    x_m = np.arange(91.0)
    path = np.stack([np.column_stack([x_m, 0 * x_m + y, 0 * x_m]) for y in (0, 400)])
    scene = build_scene(path, [0, 0])
    everywhere = dataclasses.replace(SETTINGS, max_ego_distance_m=1e9)

    assert tokens_of(scene, until=10).num_agents == 1
    assert tokens_of(scene, everywhere, until=10).num_agents == 2


def test_the_ego_keeps_its_row_among_those_kept(tokens_of, build_scene):
    x_m = np.arange(91.0)
    rows = [np.column_stack([x_m, 0 * x_m + 4 * row, 0 * x_m]) for row in range(4)]
    valid = np.ones((4, 91), bool)
    valid[0] = False  # never there
    scene = build_scene(np.stack(rows), [0, 3, 1, 0], valid, ego=3)

    tokens = tokens_of(scene)

    assert tokens.track_id.tolist() == [102, 103]
    assert tokens.ego == 1


def test_a_scene_that_cannot_be_tokenized_says_why(tokens_of, drive):
    with pytest.raises(TokensError, match="which no token ends at"):
        tokens_of(drive(now=13))


def test_road_tokens_lie_on_the_map(tokens_of, drive):
    tokens = tokens_of(drive())

    lane = tokens.map_polyline == tokens.map_polyline[0]
    np.testing.assert_allclose(tokens.map_pose[lane, 1:], 0.0, atol=1e-5)
    assert len(tokens.map_token) == len(tokens.map_pose) == tokens.num_map_tokens
    assert (np.diff(tokens.map_polyline) >= 0).all()


def test_road_tokens_know_the_light_of_their_lane_now(tokens_of, drive, build_signals):
    lights = build_signals([(9, 1, SignalState.GO), (10, 1, SignalState.ARROW_STOP)])

    tokens = tokens_of(drive(signals=lights))

    lane = tokens.map_polyline == tokens.signal_polyline[0]
    assert (tokens.map_signal[lane] == SignalClass.STOP).all()
    assert (tokens.map_signal[~lane] == SignalClass.NO_SIGNAL).all()


def test_lights_are_told_at_the_end_of_every_token(tokens_of, drive, build_signals):
    lights = [
        (step, 1, SignalState.STOP if step < 15 else SignalState.GO) for step in range(91)
    ]

    tokens = tokens_of(drive(signals=build_signals(lights)))

    assert len(tokens.signal_polyline) == 1
    expected = [SignalClass.STOP] * 2 + [SignalClass.GO] * 16
    np.testing.assert_array_equal(tokens.signal_state, [expected])


def test_the_same_scene_gives_the_same_tokens(tokens_of, crossing):
    one, two = tokens_of(crossing()), tokens_of(crossing())

    for field in dataclasses.fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))


def test_tokenizing_leaves_the_scene_alone(tokens_of, crossing):
    scene, untouched = crossing(), crossing()

    tokens_of(scene)

    for name in ("xyz_m", "heading_rad", "velocity_mps", "valid", "size_lwh_m"):
        one, two = getattr(scene.tracks, name), getattr(untouched.tracks, name)
        np.testing.assert_array_equal(one, two)


def test_a_long_log_has_tokens_beyond_what_a_byte_can_count(tokens_of, parked):
    tokens = tokens_of(parked(count=1, steps=3111))

    assert tokens.num_tokens == 622
    assert tokens.sequence_step.max() == 621


def test_a_scene_without_a_map_has_no_road_tokens(tokens_of, drive, build_map):
    tokens = tokens_of(drive(road_map=build_map([])))

    assert tokens.num_map_tokens == 0
    assert len(tokens.signal_polyline) == 0
