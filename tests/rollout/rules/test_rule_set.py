"""One setting for all rules: what it stands for, and that rollouts do just that."""

import dataclasses
from dataclasses import fields

import numpy as np
import pytest

from infgen.config import RolloutSettings
from infgen.errors import ConfigError
from infgen.rollout.recording import Frame
from infgen.rollout.rules.rule_set import RULE_SETS, RuleSet
from infgen.rollout.session import Session
from infgen.settings import build
from tests.rollout.single_rules import ALL_OFF, only

AS_THEY_WERE = {
    "max_motion_samples": 32,
    "reject_off_road": True,
    "max_stall_s": 20.0,
    "density_control": 1.0,
    "insertion_mask": True,
    "insertion_lane_distance_m": 25.0,
    "max_insertion_attempts": 16,
}
"""What profiles ``pretrained``, ``demo`` and ``benchmark`` set one by one before."""


@pytest.fixture
def frames(crossing, parked, start, simulator, force):
    """``frames(**settings)``: six token steps of four rollouts with much going on."""

    def play(**settings):
        playing = simulator(max_insertions=2, motion_top_k=0, position_top_k=0, **settings)
        force(playing, add=0.5, leave=-2.0)
        scenes = [crossing(), parked(5)] * 2
        session = Session(playing, [start(each, at) for at, each in enumerate(scenes)])
        return [session.step() for _ in range(6)]

    return play


def equal(ours, theirs):
    """Whether two rollouts are the same to the last bit."""
    return all(
        np.array_equal(getattr(one, field.name), getattr(other, field.name))
        for one, other in zip(ours, theirs, strict=True)
        for field in fields(Frame)
    )


def test_without_rules_rollouts_are_those_of_every_rule_switched_off(frames):
    assert equal(frames(), frames(**ALL_OFF))
    assert equal(frames(rules="none"), frames())


def test_safe_rollouts_are_those_of_the_values_that_were_set_one_by_one(frames):
    assert equal(frames(rules="safe"), frames(**only(**AS_THEY_WERE)))
    assert not equal(frames(rules="safe"), frames())


@pytest.mark.parametrize(
    "rule",
    [
        {"max_motion_samples": 32},
        {"max_motion_samples": 2, "max_stall_s": 1.0},
        {"max_motion_samples": 32, "reject_off_road": True},
        {"density_control": 2.0},
        {"insertion_mask": True},
    ],
)
def test_each_rule_changes_rollouts(frames, rule):
    assert not equal(frames(**only(**rule)), frames())


def test_none_has_no_rule_and_safe_all_of_them():
    assert RolloutSettings().rules == "none"
    assert RolloutSettings().rule_set == RuleSet(1, False, 0.0, 0.0, False, np.inf, 1)
    assert RolloutSettings(rules="safe").rule_set == RuleSet(**AS_THEY_WERE)


@pytest.mark.parametrize("name", AS_THEY_WERE)
def test_without_rules_a_rule_is_refused_with_the_way_out(name):
    given = {name: AS_THEY_WERE[name]}

    with pytest.raises(ConfigError, match=rf"^rollout: {name} is .*set rules=safe, or"):
        build(RolloutSettings, given, "rollout")
    assert build(RolloutSettings, {**given, "rules": "safe"}, "rollout")


def test_without_rules_a_rule_may_be_switched_off_in_words():
    settings = RolloutSettings(max_motion_samples=1, insertion_mask=False)

    assert settings.rule_set == RULE_SETS["none"]


@pytest.mark.parametrize("name", ["reject_off_road", "max_stall_s"])
def test_a_rule_that_needs_another_is_refused_without_it(name):
    value = AS_THEY_WERE[name]

    with pytest.raises(
        ConfigError, match=rf"{name} is {value} .*set max_motion_samples=32"
    ):
        build(RolloutSettings, only(**{name: value}), "rollout")


def test_single_rules_of_safe_may_be_changed_and_the_words_say_which():
    settings = RolloutSettings(
        rules="safe", max_stall_s=30.0, reject_off_road=False, density_control=1.0
    )

    assert settings.rule_set == dataclasses.replace(
        RULE_SETS["safe"], max_stall_s=30.0, reject_off_road=False
    )
    assert settings.rules_in_words == "safe, reject_off_road=false, max_stall_s=30"
    assert RolloutSettings().rules_in_words == "none"


def test_other_rules_come_whole():
    changed = RolloutSettings(rules="safe", max_stall_s=30.0, seconds=4.0)

    assert changed.with_rules("safe") is changed
    assert changed.with_rules("none") == RolloutSettings(seconds=4.0)
    assert RolloutSettings().with_rules("safe") == RolloutSettings(rules="safe")
