"""Contacts and distances to lanes, on a street that is easily reckoned by hand."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from infgen.metrics.motion import Motion
from infgen.metrics.placement import Events
from infgen.metrics.traffic import Traffic

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
NOW, STEPS = 10, 61
# Two lanes, 3.5 m apart: the lower one leads east, the upper one west.
LANES = (
    np.array([[-100, 0, 0], [100, 3.5, 0]], dtype=np.float32),
    np.array([[200, 0, 0], [-200, 0, 0]], dtype=np.float32),
)


@pytest.fixture
def contacts(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("contacts")


def traffic(*agents):
    """Cars of 4 m x 2 m: where each is at step 0, heading, m/s, and its first step."""
    step = np.arange(STEPS)
    x_m, y_m, heading_rad, mps, first = np.array(agents).T[..., None]
    parts = {
        "x_m": x_m + mps * np.cos(heading_rad) * step / 10,
        "y_m": y_m + mps * np.sin(heading_rad) * step / 10,
        "z_m": np.zeros((len(agents), STEPS)),
        "heading_rad": np.broadcast_to(heading_rad, (len(agents), STEPS)),
    }
    motion = Motion(
        **{name: part[None].astype(np.float32) for name, part in parts.items()},
        size_lwh_m=np.tile(np.float32([4, 2, 1.5]), (len(agents), 1)),
        agent_type=np.zeros(len(agents), dtype=np.int8),
        valid=(step >= first)[None],
    )
    nothing = np.zeros(0, np.int16), np.zeros(0, np.float32)
    return Traffic("made", 0, NOW, 0, motion, Events(*nothing, *nothing))


def test_a_contact_is_counted_once_by_who_takes_part_and_what_they_do(contacts):
    # The ego comes at 10 m/s and reaches a car inserted at 30 m after 2.6 s; it is through
    # after 0.8 s. A third car stands aside.
    side = contacts.Side()
    cars = (0, 0, 0, 10, 0), (30, 1, 0, 0, 15), (30, 9, 0, 0, 0)

    contacts.take(side, traffic(*cars), LANES)

    assert side.kinds == {
        "contacts": 1,
        "one stands": 1,
        "one inserted": 1,
        "vehicles and vehicles": 1,
    }
    assert side.lasted_s == [pytest.approx(0.8, abs=0.11)]
    assert not side.moving


@pytest.mark.parametrize(
    ("heading_deg", "first", "told"),
    [
        (10, 0, {"same way": 1}),
        (45, 0, {"merging": 1}),
        (90, 15, {"crossing": 1, "one inserted within 3 s": 1}),
        (-170, 15, {"head on": 1, "one inserted within 3 s": 1}),
    ],
)
def test_two_vehicles_that_move_meet_at_an_angle(contacts, heading_deg, first, told):
    side = contacts.Side()
    other = (20, -1, np.radians(heading_deg), 1, first)

    contacts.take(side, traffic((0, 0, 0, 10, 0), other), LANES)

    assert side.moving == told


def test_who_was_inserted_long_before_is_not_fresh(contacts):
    side = contacts.Side()

    contacts.take(side, traffic((0, 0, 0, 10, 0), (50, -2, np.pi / 2, 0.6, 11)), LANES)

    assert side.moving == {"crossing": 1}


def test_vehicles_are_told_by_how_far_from_a_lane_and_which_way_they_face(contacts):
    # In the lane; turned by 2 degrees and off its middle; against it; far from every lane.
    turned_rad = np.radians(2)
    cars = [(0, 0, 0, 0, 0), (0, -1.2, turned_rad, 0, 0), (0, 0.5, np.pi, 0, 0)]
    made = traffic(*cars, (0, 40, 0, 0, 0))

    found = contacts.beside_lanes(made, np.arange(4), NOW, LANES)

    assert found.shape == (3, 3)
    np.testing.assert_allclose(found[:, 0], [0, 1.2, 0.5], atol=1e-5)
    np.testing.assert_allclose(found[:, 1], [0, 2, 0], atol=1e-4)
    np.testing.assert_allclose(found[:, 2], [0, 1.2, 3.0], atol=1e-5)
    numbers = contacts._spread(found)
    assert numbers["against"] == 0.5
    assert numbers["0.75 to 1.75 m"] == pytest.approx(1 / 3)
