import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.rollout.recording import NO_AGENT
from infgen.views.player.payload import unpack
from infgen.views.scene.view_model import Role
from pipeline.drive import messages
from pipeline.drive.car import Controls
from pipeline.drive.messages import (
    MAX_BYTES,
    ControlMessage,
    MessageError,
    OpenMessage,
    PressMessage,
    read_message,
)

CONTROL = {"type": "control", "throttle": 1, "brake": 0, "steer": -0.5}
PRESS = {"type": "press", "button": "pause"}
OPEN = {"type": "open", "scene": 2, "seed": 7}


def test_messages_of_a_page_are_read():
    assert read_message(json.dumps(CONTROL)).controls == Controls(1.0, 0.0, -0.5)
    assert read_message(json.dumps(PRESS)).button == "pause"
    read = read_message(json.dumps(OPEN))
    assert (read.scene, read.seed) == (2, 7)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        "[]",
        "{}",
        '{"type": "control"}',
        '{"type": "quit"}',
        json.dumps({**CONTROL, "steer": 1.01}),
        json.dumps({**CONTROL, "throttle": -0.01}),
        json.dumps({**CONTROL, "brake": True}),
        json.dumps({**CONTROL, "brake": "1"}),
        json.dumps({**CONTROL, "x": 1}),
        json.dumps({**CONTROL, "steer": float("nan")}),
        json.dumps({**CONTROL, "steer": float("inf")}),
        json.dumps({**CONTROL, "steer": None}),
        '{"type":"control","throttle":1e999,"brake":0,"steer":0}',
        json.dumps({**PRESS, "button": "exit"}),
        json.dumps({**PRESS, "button": ["pause"]}),
        json.dumps({**OPEN, "scene": -1}),
        json.dumps({**OPEN, "scene": 1.5}),
        json.dumps({**OPEN, "scene": "1"}),
        json.dumps({**OPEN, "seed": 2**31}),
        json.dumps({**OPEN, "scene": 10**400}),
        json.dumps(PRESS) + " " * MAX_BYTES,
        json.dumps({**PRESS, "button": "ä" * 120}, ensure_ascii=False),
        json.dumps(PRESS) * 2,
        '{"type": "press", "button": "\ud800"}',
        b'{"type": "press", "button": "pause"}',
        "[" * 200,
    ],
)
def test_others_are_refused(text):
    with pytest.raises(MessageError):
        read_message(text)


def test_a_refusal_names_the_field_and_stays_short():
    with pytest.raises(MessageError, match=r"control\.steer: .*less than or equal to 1"):
        read_message(json.dumps({**CONTROL, "steer": 3}))
    with pytest.raises(MessageError) as refused:
        read_message('{"type": "%s"}' % ("x" * 200))
    assert len(str(refused.value)) <= MAX_BYTES


_VALUES = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3),
    max_leaves=4,
)
_KEYS = st.sampled_from(["type", "throttle", "brake", "steer", "button", "scene", "seed"])


@given(st.text(max_size=80) | st.dictionaries(_KEYS, _VALUES, max_size=5).map(json.dumps))
def test_anything_is_read_whole_or_refused(text):
    try:
        read = read_message(text)
    except MessageError:
        return
    assert isinstance(read, ControlMessage | OpenMessage | PressMessage)


@given(
    st.fixed_dictionaries(
        {
            "type": st.just("control"),
            "throttle": st.floats(),
            "brake": st.floats(),
            "steer": st.floats(),
        }
    ).map(json.dumps)
)
def test_controls_that_are_read_are_finite_and_within_bounds(text):
    try:
        controls = read_message(text).controls
    except MessageError:
        return
    assert 0 <= controls.throttle <= 1
    assert 0 <= controls.brake <= 1
    assert -1 <= controls.steer <= 1


def test_a_scene_is_shown_with_its_history_as_the_player_packs_it(begin):
    drive = begin()
    start = drive.world.start

    said = json.loads(messages.scene_message(drive.world, ["a", "b"], 1))
    film = unpack(said["payload"])

    (showing,) = film.showings
    assert (said["scenes"], said["number"], said["seed"]) == (["a", "b"], 1, 0)
    assert said["rules"] == drive.world.simulator.settings.rules_in_words
    np.testing.assert_array_equal(showing.id, start.history.track_id)
    assert showing.role[showing.ego] == Role.EGO
    assert showing.num_steps == start.scene.now + 1
    log = start.scene.tracks.xyz_m[start.logged_row, start.scene.now, :2]
    there = showing.valid[:, -1]
    np.testing.assert_allclose(showing.pose[there, -1, :2], log[there], atol=0.01)
    assert film.lights.state.shape[1] == 1


def test_a_frame_names_all_but_the_ego(begin):
    drive = begin()

    said = json.loads(messages.frame_message(drive.world, drive.shown))

    assert said["token"] == drive.shown.token
    assert len(said["id"]) == drive.shown.present.sum() - 1
    assert (
        int(drive.world.start.history.track_id[drive.world.start.history.ego])
        not in said["id"]
    )
    np.testing.assert_allclose(
        np.reshape(said["path"][0], (5, 3)), drive.shown.path[1], atol=6e-4
    )


def test_a_frame_without_other_agents_is_empty(begin):
    drive = begin()
    begun = drive.shown.begun
    numbers = np.full_like(begun.moved.agent_number, NO_AGENT)
    numbers[0, 0] = begun.moved.agent_number[0, 0]
    moved = dataclasses.replace(begun.moved, agent_number=numbers)

    begun = dataclasses.replace(begun, moved=moved)
    alone = dataclasses.replace(drive.shown, begun=begun)
    said = json.loads(messages.frame_message(drive.world, alone))

    assert said["id"] == said["path"] == said["size"] == []


def test_the_state_has_the_figures_of_the_drive(begin):
    drive = begin()
    for _ in range(25):
        moment = drive.tick(Controls())

    state = json.loads(messages.state_message(drive, paused=False))
    ego = json.loads(messages.ego_message(moment, drive))

    assert (state["seconds"], state["recorded"], state["steps"]) == (0.62, 0.5, 2)
    assert state["agents"] == drive.shown.present.sum()
    assert 0 < state["p50"] <= state["p99"]
    assert ego["step"] == 16.25
    np.testing.assert_allclose(ego["pose"], moment.pose, atol=1e-3)
