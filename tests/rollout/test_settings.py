import pytest

from infgen.config import RolloutSettings
from infgen.errors import ConfigError
from infgen.rollout.settings import MODES
from infgen.settings import build

SAFE = {"rules": "safe"}


@pytest.mark.parametrize(
    ("mode", "duration_s", "all_agents", "inserts"),
    [
        ("long", 30.0, False, True),
        ("motion-only", 30.0, False, False),
        ("wosac", 8.0, True, False),
    ],
)
def test_the_mode_decides_duration_agents_insertion_and_removal(
    mode, duration_s, all_agents, inserts
):
    settings = RolloutSettings(mode=mode)

    assert settings.duration_s == duration_s
    assert settings.simulates_all_agents == all_agents
    assert settings.inserts == settings.removes == inserts


def test_what_a_mode_leaves_open_may_be_set():
    settings = build(
        RolloutSettings,
        {"mode": "motion-only", "seconds": "12", "all_agents": "true"},
        "-s",
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
        {"mode": "wosac", "all_agents": False},
        {"mode": "motion-only", "remove": True},
    ],
)
def test_what_contradicts_the_mode_is_refused(given):
    name = next(name for name in given if name != "mode")

    with pytest.raises(ConfigError, match=rf"rollout: {name} is .*mode={given['mode']}"):
        build(RolloutSettings, given, "rollout")


def test_setting_what_the_mode_fixes_to_the_same_is_allowed():
    mode = MODES["wosac"]

    settings = RolloutSettings(mode="wosac", seconds=mode.seconds, insert=mode.insert)

    assert settings.duration_s == 8


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"mode": "short"}, "expected 'long', 'motion-only' or 'wosac'"),
        ({"motion_temperature": 0.0}, "expected greater than 0"),
        ({"heading_temperature": float("nan")}, "expected a finite number"),
        ({"position_top_p": 1.5}, "less than or equal to 1"),
        ({"motion_top_p": 0.0}, "greater than 0"),
        ({"max_insertion_attempts": 0, **SAFE}, "greater than or equal to 1"),
        ({"removal_radius_m": -1.0}, "greater than or equal to 0"),
        ({"max_stall_s": -1.0, **SAFE}, "greater than or equal to 0"),
        ({"density_control": -0.5, **SAFE}, "greater than or equal to 0"),
        ({"rules": "Safe"}, "expected 'none' or 'safe'"),
    ],
)
def test_impossible_values_are_refused(given, said):
    with pytest.raises(ConfigError, match=said):
        build(RolloutSettings, given, "rollout")
