"""Traffic as SUMO plays it at a crossing with a light."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from infgen.sources.towns.road_users import draw_motorist
from infgen.sources.towns.traffic.demand import Trip, write_routes
from infgen.sources.towns.traffic.simulation import play
from tests.sources.towns.conftest import needs_sumo

NET = Path(__file__).parents[1] / "crossing.net.xml"
STEPS = 600
DRIVER = draw_motorist(np.random.default_rng(0))

pytestmark = [needs_sumo, pytest.mark.slow]


def play_trips(folder, trips, most_vehicles=100):
    write_routes(trips, folder / "town.rou.xml")
    return play(NET, folder / "town.rou.xml", len(trips), most_vehicles, 0.0, STEPS, 1)


def set_off_step(folder, hesitation_s):
    """The step at which a driver whose light is red for 42 s moves on."""
    driver = replace(DRIVER, hesitation_s=hesitation_s)
    played = play_trips(folder, [Trip(driver, 0.1, ["e1b", "e3f"], anywhere=False)])
    stands = played.present[0] & (played.speed_mps[0] < 0.05)
    assert stands.sum() > 100
    return int(np.flatnonzero(stands)[-1]) + 1


def test_who_hesitates_sets_off_later(tmp_path):
    at_once, later = (set_off_step(tmp_path, each) for each in (0.0, 2.0))

    # Drivers make up their minds every four steps.
    assert later - at_once == pytest.approx(20, abs=4)


def test_a_town_never_holds_more_vehicles_than_it_may(tmp_path):
    trips = [
        Trip(DRIVER, 0.1 + at, [f"e{at % 4}b", f"e{(at + 2) % 4}f"], anywhere=False)
        for at in range(60)
    ]

    free, full = (play_trips(tmp_path, trips, most).present.sum(axis=0) for most in (60, 8))

    assert free.max() > 8
    assert full.max() == 8
