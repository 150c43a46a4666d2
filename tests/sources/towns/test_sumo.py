import pytest

from infgen.sources.towns import sumo
from infgen.sources.towns.sumo import SumoError, check_installed, run_program
from tests.sources.towns.conftest import needs_sumo


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
