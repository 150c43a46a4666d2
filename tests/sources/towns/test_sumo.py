import pytest

from infgen.sources.towns import sumo
from infgen.sources.towns.sumo import (
    SumoError,
    check_installed,
    run_program,
    run_stepwise,
)
from tests.sources.towns.conftest import needs_libsumo, needs_sumo


def test_without_sumo_the_message_names_the_extra(monkeypatch):
    monkeypatch.setattr(sumo, "PACKAGE", "no_such_package")

    with pytest.raises(
        SumoError, match=r"SUMO is not installed.*pip install 'infgen\[towns"
    ):
        check_installed()


@needs_sumo
def test_a_program_that_fails_is_quoted(tmp_path):
    with pytest.raises(SumoError, match=r"sumo failed with code 1: .*none\.net\.xml"):
        run_program("sumo", {"net-file": tmp_path / "none.net.xml"})


@needs_sumo
def test_a_program_does_what_it_is_told(tmp_path):
    net = tmp_path / "grid.net.xml"
    run_program("netgenerate", {"grid": True, "grid.number": 2, "output-file": net})

    assert net.stat().st_size > 1000


def test_without_the_library_the_message_names_the_extra(monkeypatch):
    monkeypatch.setattr(sumo, "LIBRARY", "no_such_package")

    with pytest.raises(SumoError, match=r"no_such_package is not .*infgen\[towns"):
        run_stepwise({}, 1, lambda _: lambda step: None)


@needs_libsumo
def test_steps_are_made_one_by_one(tmp_path):
    net, seen = tmp_path / "grid.net.xml", []
    run_program("netgenerate", {"grid": True, "grid.number": 2, "output-file": net})

    for _ in range(2):  # One simulation after the other.
        run_stepwise({"net-file": net}, 3, lambda libsumo: seen.append)

    assert seen == [0, 1, 2] * 2


@needs_libsumo
def test_a_simulation_that_fails_leaves_room_for_the_next(tmp_path):
    with pytest.raises(SumoError, match="sumo failed"):
        run_stepwise({"net-file": tmp_path / "none.net.xml"}, 1, lambda _: print)

    test_steps_are_made_one_by_one(tmp_path)
