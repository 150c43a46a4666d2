import os

import pytest

from pipeline.engine import machine


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """Files of a kernel that knows two cores and two cards."""
    monkeypatch.setattr(machine, "CPUS", tmp_path / "cpuinfo")
    monkeypatch.setattr(machine, "GPUS", tmp_path / "gpus")
    machine.describe.cache_clear()
    yield tmp_path
    machine.describe.cache_clear()


def test_processor_and_cards_are_named(kernel):
    core = "processor\t: {}\nmodel name\t: A Fast CPU  \nflags\t: model\n\n"
    (kernel / "cpuinfo").write_text(core.format(0) + core.format(1))
    for card in ("b", "a"):
        (kernel / "gpus" / card).mkdir(parents=True)
        (kernel / "gpus" / card / "information").write_text(f"Model: \t\t Card {card}\n")

    about = machine.describe()

    assert about["processor"] == "A Fast CPU"
    assert about["gpus"] == ["Card a", "Card b"]
    assert about["cores"] == os.cpu_count()
    assert about["memory_gib"] > 0


def test_what_a_machine_does_not_tell_is_left_out(kernel):
    about = machine.describe()

    assert about["processor"]
    assert about["gpus"] == []
