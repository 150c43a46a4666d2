"""Traffic lights after the history: as they were last, or as somebody says they go on."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.config import RolloutSettings
from infgen.errors import ConfigError
from infgen.rollout.session import Session
from infgen.scene import SignalState
from infgen.settings import build
from infgen.tokens.scene_tokens import SignalClass
from infgen.tokens.signals import LoggedSignals
from infgen.tokens.tokenizer import read_logged_signals

SEES = {"signals_each_step": True}


@pytest.fixture
def lit(crossing, build_signals):
    """A crossing whose first lane has a light: red at first, green from step 31 on."""
    scene = crossing()
    lane = int(scene.road_map.feature_id[0])
    states = [
        (step, lane, SignalState.STOP if step < 31 else SignalState.GO)
        for step in range(scene.tracks.num_steps)
    ]
    return replace(scene, signals=build_signals(states))


@pytest.fixture
def play(simulator, start):
    """``play(scene, lights, model=...)``: logits of moves, token step by token step."""

    def build(scene, lights, model=SEES):
        playing = simulator(model, insert=False, remove=False, motion_top_k=1)
        network = playing.stepper.network
        with torch.no_grad():
            network.roads.signal.weight.normal_(std=3.0)
        session = Session(playing, replace(start(scene), lights=lights))
        step, said = playing.stepper.motion_step, []

        def heard(memory, token_step, rows):
            said.append(step(memory, token_step, rows))
            return said[-1]

        playing.stepper.motion_step = heard
        for _ in range(6):
            session.step()
        return [one.packed.motion_logits for one in said]

    return build


def test_lights_are_read_to_the_end_of_the_log(lit):
    lights = read_logged_signals(lit)

    assert len(lights.polyline) == 1
    assert lights.shown.shape == (1, (lit.tracks.num_steps - 1) // 5)
    stop, go = SignalClass.STOP, SignalClass.GO
    assert lights.shown[0, :8].tolist() == [stop] * 6 + [go] * 2


def test_what_follows_a_light_that_changes_changes_and_nothing_before(lit, play):
    lasting = read_logged_signals(lit)
    changing = LoggedSignals(lasting.polyline, lasting.shown.copy())
    changing.shown[:, 5:] = SignalClass.CAUTION

    one, other = play(lit, lasting), play(lit, changing)

    # The first half second played follows token 1.
    for token, (a, b) in enumerate(zip(one, other, strict=True), start=1):
        assert torch.equal(a, b) == (token < 5)


def test_without_a_word_lights_stay_as_they_were_last(lit, play):
    kept = read_logged_signals(lit)
    stays = LoggedSignals(kept.polyline, kept.shown[:, :2])

    for a, b in zip(play(lit, None), play(lit, stays), strict=True):
        torch.testing.assert_close(a, b)


def test_a_light_nobody_looks_at_any_more_looks_like_no_light_that_is_seen(lit, play):
    kept = read_logged_signals(lit)
    held = LoggedSignals(
        kept.polyline, np.repeat(kept.shown[:, 1:2], kept.shown.shape[1], axis=1)
    )

    one, other = play(lit, held), play(lit, None)

    for token, (a, b) in enumerate(zip(one, other, strict=True), start=1):
        assert torch.equal(a, b) == (token < 2)


def test_weights_that_do_not_see_lights_change_are_not_told(lit, play):
    lights = read_logged_signals(lit)

    told, untold = (play(lit, each, {}) for each in (lights, None))

    assert all(torch.equal(a, b) for a, b in zip(told, untold, strict=True))


def test_lights_of_scenes_side_by_side_last_as_long_as_each_has_them(lit, play):
    lights = read_logged_signals(lit)
    shorter = LoggedSignals(lights.polyline, lights.shown[:, :7])
    same = np.array_equal(lights.shown[:, 6], lights.shown[:, -1])

    assert same  # Green to the end of the log.
    for a, b in zip(play(lit, lights), play(lit, shorter), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"signals": "off"}, "expected 'now' or 'log'"),
        ({"mode": "wosac"}, "shows the future"),
    ],
)
def test_lights_are_of_now_or_of_the_log_and_never_foreseen_by_waymos_rules(settings, said):
    with pytest.raises(ConfigError, match=said):
        build(RolloutSettings, {"signals": "log", **settings}, "rollout")
