import pytest

from infgen.config import RolloutSettings
from infgen.errors import ConfigError
from infgen.settings import build
from infgen.rollout.settings import MODES


@pytest.mark.parametrize(
    ("mode", "duration_s", "everyone", "comes_and_goes"),
    [
        ("long", 30.0, False, True),
        ("motion-only", 30.0, False, False),
        ("wosac", 8.0, True, False),
    ],
)
def test_one_word_says_what_is_played(mode, duration_s, everyone, comes_and_goes):
    settings = RolloutSettings(mode=mode)

    assert settings.duration_s == duration_s
    assert settings.simulates_all_agents == everyone
    assert settings.inserts == settings.removes == comes_and_goes


def test_what_a_mode_leaves_open_may_be_said():
    settings = build(
        RolloutSettings, {"mode": "motion-only", "seconds": "12", "everyone": "true"}, "-s"
    )

    assert settings.duration_s == 12
    assert settings.simulates_all_agents
    assert not settings.inserts
    assert not RolloutSettings(insert=False).inserts
    assert RolloutSettings(insert=False).removes


@pytest.mark.parametrize(
    "given",
    [
        {"mode": "wosac", "seconds": 30.0},
        {"mode": "wosac", "insert": True},
        {"mode": "wosac", "everyone": False},
        {"mode": "motion-only", "remove": True},
    ],
)
def test_what_contradicts_the_mode_is_refused_with_the_way_out(given):
    name = next(name for name in given if name != "mode")

    with pytest.raises(ConfigError, match=rf"rollout.{name} is .*mode={given['mode']}"):
        RolloutSettings(**given)


def test_saying_what_the_mode_says_is_no_contradiction():
    mode = MODES["wosac"]

    settings = RolloutSettings(mode="wosac", seconds=mode.seconds, insert=mode.insert)

    assert settings.duration_s == 8


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"mode": "short"}, "expected long or motion-only or wosac"),
        ({"motion_temperature": 0.0}, "more than 0"),
        ({"heading_temperature": float("nan")}, "more than 0"),
        ({"position_top_p": 1.5}, "up to 1"),
        ({"motion_top_p": 0.0}, "above 0"),
        ({"max_insertion_attempts": 0}, "1 or more"),
        ({"removal_radius_m": -1.0}, "0 or more"),
        ({"reject_off_road": True}, "say rollout.max_motion_samples=32"),
        ({"max_stall_s": 20.0}, "say rollout.max_motion_samples=32"),
        ({"max_stall_s": -1.0, "max_motion_samples": 2}, "0 or more"),
        ({"density_control": -0.5}, "0 or more"),
    ],
)
def test_nonsense_is_refused(given, said):
    with pytest.raises(ConfigError, match=said):
        RolloutSettings(**given)
