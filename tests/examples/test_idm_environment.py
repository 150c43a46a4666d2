"""The Intelligent Driver Model drives the environment as it would drive anything."""

import importlib
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="needs the extra `gym`")

from infgen.environment.observation import AGENTS, EGO, SIGNALS

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def idm(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module("idm_environment")


@pytest.fixture
def seen():
    """``seen(speed_mps, agents=[(x, y, speed)], red=[x])``: what the ego observes."""

    def build(speed_mps=8.0, agents=(), red=(), left_m=0.0):
        ego = dict.fromkeys(EGO, 0.0) | {"speed_mps": speed_mps, "length_m": 5.0}
        observed = {
            "ego": np.array([(ego | {"route_left_m": left_m})[name] for name in EGO]),
            "agents": np.zeros((4, len(AGENTS))),
            "agents_mask": np.arange(4) < len(agents),
            "signals": np.zeros((2, len(SIGNALS))),
            "signals_mask": np.arange(2) < len(red),
            "route": np.stack([5.0 * np.arange(1, 11), np.full(10, left_m)], axis=1),
        }
        for row, (x_m, y_m, speed) in enumerate(agents):
            told = {"x_m": x_m, "y_m": y_m, "velocity_x_mps": speed, "length_m": 5.0}
            observed["agents"][row] = [told.get(name, 0.0) for name in AGENTS]
        for row, x_m in enumerate(red):
            told = {"x_m": x_m, "heading_cos": 1.0, "is_stop": 1.0}
            observed["signals"][row] = [told.get(name, 0.0) for name in SIGNALS]
        return observed

    return build


def test_on_a_free_road_it_accelerates_up_to_its_speed(idm, seen):
    accels = [idm.drive(seen(speed))[0] for speed in (0.0, 5.0, idm.DESIRED_MPS)]

    assert accels[0] == pytest.approx(idm.MAX_ACCEL_MPS2)
    assert accels[0] > accels[1] > accels[2] == pytest.approx(0.0, abs=1e-6)


def test_the_gap_is_from_bumper_to_bumper_of_who_is_in_the_way(idm, seen):
    others = [(20.0, 0.0, 6.0), (12.0, 3.0, 0.0), (-9.0, 0.0, 20.0)]

    assert idm.gap_ahead(seen(8.0, others), 8.0, 5.0) == pytest.approx((15.0, 2.0))


def test_it_brakes_for_who_stands_and_for_a_red_signal(idm, seen):
    assert idm.drive(seen(8.0, [(15.0, 0.0, 0.0)]))[0] < -2.0
    assert idm.drive(seen(8.0, red=[12.0]))[0] < -2.0
    assert idm.drive(seen(8.0, red=[-12.0]))[0] > 0.0


def test_it_steers_to_its_route(idm, seen):
    assert idm.drive(seen())[1] == 0.0
    assert idm.drive(seen(left_m=1.0))[1] > 0.05
    assert idm.drive(seen(left_m=-1.0))[1] == -idm.drive(seen(left_m=1.0))[1]


def test_it_slows_for_a_turn_and_the_sooner_the_nearer_it_is(idm):
    straight = np.stack([5.0 * np.arange(1, 11), np.zeros(10)], axis=1)
    near, far = straight.copy(), straight.copy()
    near[1:] = [5.0, 0.0] + 5.0 * np.stack([np.zeros(9), np.arange(1, 10)], axis=1)
    far[3:] = [15.0, 0.0] + 5.0 * np.stack([np.zeros(7), np.arange(1, 8)], axis=1)

    speeds = [idm.slow_for_turns(route) for route in (straight, far, near)]

    assert speeds[0] == idm.DESIRED_MPS
    assert speeds[0] > speeds[1] > speeds[2] > 1.0


def test_it_drives_in_a_town_of_the_package(idm, capsys):
    idm.main(["--scene", "2", "--seconds", "1"])

    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + 1 + 1
    assert lines[1].split()[0] == "1.0"
    assert lines[-1].startswith("time is up")
