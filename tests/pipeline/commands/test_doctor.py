import pytest

from pipeline.commands import doctor
from pipeline.commands.doctor import examine


def test_this_machine_can_do_what_a_run_needs(workshop):
    checks = {check.what: check for check in examine(workshop.root)}

    assert not [check for check in checks.values() if check.state == "bad"]
    assert checks["locks"].state == checks["links"].state == "ok"
    assert not list(workshop.root.path.iterdir())


def test_a_missing_package_is_named_with_the_way_out(workshop, monkeypatch):
    monkeypatch.setattr(doctor, "PACKAGES", ("nowhere",))
    checks = {check.what: check for check in examine(workshop.root)}

    assert checks["nowhere"].state == "bad"
    assert "pip install nowhere" in checks["nowhere"].note


def test_a_disk_whose_locks_do_not_hold_is_bad(workshop, monkeypatch):
    monkeypatch.setattr(doctor, "is_locked", lambda path: False)
    checks = {check.what: check for check in examine(workshop.root)}

    assert checks["locks"].state == "bad"


@pytest.mark.parametrize(("free", "state"), [(1 << 30, "warn"), (1 << 40, "ok")])
def test_a_full_disk_is_warned_of(workshop, monkeypatch, free, state):
    usage = type("Usage", (), {"free": free})
    monkeypatch.setattr("shutil.disk_usage", lambda path: usage)

    assert {c.what: c for c in examine(workshop.root)}["disk"].state == state
