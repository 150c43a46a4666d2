"""Drivers who do not look ahead, at a crossing that SUMO plays."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from infgen.clock import CLOCK
from infgen.sources.towns.numbering import draw_scenes
from infgen.sources.towns.road_users import draw_motorist
from infgen.sources.towns.traffic.demand import Trip, write_routes
from infgen.sources.towns.traffic.simulation import play
from infgen.sources.towns.variety import BASIC, RECOVERY, Inattention
from tests.sources.towns.conftest import needs_libsumo, needs_sumo

NET = Path(__file__).parents[1] / "crossing.net.xml"
STEPS = 300
DRIVER = replace(draw_motorist(np.random.default_rng(0)), hesitation_s=0.0)
ALL_DRIVERS = Inattention(
    period_steps=40,
    before_steps=0,
    until_steps=20,
    share=1.0,
    steps=(15, 19),
    brake_mps2=(4.0, 4.0),
)

pytestmark = [needs_sumo, needs_libsumo]


def play_trips(folder, inattention):
    """Fourteen vehicles of seven seconds from all sides, some of whose lights are red."""
    trips = [
        Trip(DRIVER, 0.1 + at / 2, [f"e{at % 4}b", f"e{(at + 2) % 4}f"], anywhere=False)
        for at in range(14)
    ]
    write_routes(trips, folder / "town.rou.xml")
    route = folder / "town.rou.xml"
    return play(NET, route, len(trips), 100, 0.0, STEPS, 1, inattention)


def hardest_brakes_mps2(played):
    """How hard each brakes at most, of those who are there at a step and the next."""
    there = played.present[:, 1:] & played.present[:, :-1]
    change = np.diff(played.speed_mps, axis=1) / CLOCK.step_s
    return -np.where(there, change, 0.0).min(axis=1)


def test_if_no_driver_is_drawn_all_is_as_without(tmp_path):
    attentive = play_trips(tmp_path, None)
    same = play_trips(tmp_path, replace(ALL_DRIVERS, share=0.0))

    assert np.array_equal(attentive.front_m, same.front_m)
    assert np.array_equal(attentive.present, same.present)


def test_who_looks_up_late_brakes_harder(tmp_path):
    attentive, not_so = (play_trips(tmp_path, each) for each in (None, ALL_DRIVERS))

    calm, hard = hardest_brakes_mps2(attentive), hardest_brakes_mps2(not_so)
    assert hard.max() > 1.2 * calm.max()
    assert np.mean(hard > calm) > 0.5


def test_drivers_hold_a_speed_until_all_look_again(tmp_path):
    away = replace(ALL_DRIVERS, period_steps=100)
    attentive, not_so = (play_trips(tmp_path, each) for each in (None, away))

    # From step 100 on no driver looks; at the latest from step 120 on all do.
    assert share_holding(not_so, 106, 112) > share_holding(attentive, 106, 112) + 0.2
    assert share_holding(not_so, 125, 131) < share_holding(not_so, 106, 112)


def share_holding(played, begin, end):
    """Share of those who drive that hold their speed."""
    held = np.abs(np.diff(played.speed_mps, axis=1)[:, begin:end]) < 1e-6
    drives = played.present[:, begin] & (played.speed_mps[:, begin] > 3.0)
    return held[drives].all(axis=1).mean()


def test_the_same_seed_plays_the_same(tmp_path):
    one, other = (play_trips(tmp_path, ALL_DRIVERS) for _ in range(2))

    assert np.array_equal(one.front_m, other.front_m)
    assert np.array_equal(one.speed_mps, other.speed_mps)


@pytest.mark.slow
def test_scenes_begin_when_drivers_have_looked_away():
    scenes = list(draw_scenes(0, "recovery", 61, 0, 2, RECOVERY))
    basic = list(draw_scenes(0, "recovery", 61, 0, 2, BASIC))

    assert [each.scenario_id for each in scenes] != [each.scenario_id for each in basic]
    again = list(draw_scenes(0, "recovery", 61, 1, 1, RECOVERY))
    assert np.array_equal(again[0].tracks.xyz_m, scenes[1].tracks.xyz_m)
