"""``infgen towns``: whole files or none, kept when there, whoever makes them."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from infgen.errors import ConfigError
from infgen.scene import Scene
from infgen.sources.towns import sumo
from infgen.sources.towns.sumo import SumoError
from infgen.sources.womd import iter_scenes
from pipeline.engine import signals
from pipeline.engine.locks import LockedError, locked
from pipeline.storage import towns
from pipeline.storage.towns import Order, write_towns
from tests.sources.towns.conftest import needs_sumo

SHORT_S = 2.1


def order(out, **more):
    asked = {"scenes": 2, "seconds": SHORT_S, "seed": 3, "split": "training"}
    return Order(out=out, **(asked | {"scenes_per_file": 1, "jobs": 1} | more))


@pytest.fixture
def quick(monkeypatch):
    """Files of one line instead of towns, and SUMO as good as there."""
    made = []

    def write_part(part):
        made.append(part.path.name)
        part.path.write_text(f"{part.first} {part.count}")
        return part.path

    monkeypatch.setattr(towns, "write_part", write_part)
    monkeypatch.setattr(sumo, "check_installed", lambda: None)
    return made


def test_files_are_named_as_womd_names_them(tmp_path, quick):
    written = write_towns(order(tmp_path / "new", scenes=5, scenes_per_file=2))

    assert written.files == quick
    assert written.files == [f"training.tfrecord-{at:05d}-of-00003.gz" for at in range(3)]
    texts = [(tmp_path / "new" / name).read_text() for name in written.files]
    assert texts == ["0 2", "2 2", "4 1"]


def test_files_that_are_there_are_kept(tmp_path, quick):
    write_towns(order(tmp_path, scenes=3))
    (tmp_path / "training.tfrecord-00001-of-00003.gz").unlink()
    quick.clear()

    written = write_towns(order(tmp_path, scenes=3))

    assert quick == ["training.tfrecord-00001-of-00003.gz"]
    assert written.before == 2


def test_what_a_killed_run_left_half_written_is_cleared(tmp_path, quick):
    half = tmp_path / "training.tfrecord-00000-of-00002.gz.1a2b3c4d.partial"
    half.write_text("half")

    write_towns(order(tmp_path))

    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"seed": 4}, "seed 3, not 4"),
        ({"seconds": 9.1}, "steps 21, not 91"),
        ({"scenes": 3}, "scenes 2, not 3"),
        ({"scenes_per_file": 2}, "scenes_per_file 1, not 2"),
        ({"variety": "broad"}, "variety basic, not broad"),
        ({"scenes_per_town": 1}, "scenes_per_town 0, not 1"),
    ],
)
def test_towns_of_another_order_are_not_mixed_with(tmp_path, quick, more, message):
    write_towns(order(tmp_path))

    with pytest.raises(ConfigError, match=message):
        write_towns(order(tmp_path, **more))


def test_splits_may_share_a_folder(tmp_path, quick):
    write_towns(order(tmp_path))
    written = write_towns(order(tmp_path, split="validation", seed=9))

    assert written.before == 0


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"scenes": 0}, "0 scenes"),
        ({"scenes_per_file": 0}, "0 per file"),
        ({"seconds": 1.0}, "scenes of 1 s; expected 2.1 to 600"),
        ({"seconds": 601.0}, "scenes of 601 s"),
        ({"jobs": -1}, "-1 jobs"),
        ({"scenes_per_town": 11}, "11 scenes per town; variety basic has 1 to 10"),
        ({"scenes_per_town": -1}, "-1 scenes per town"),
        ({"scenes_per_town": 6, "variety": "broad"}, "variety broad has 1 to 5"),
    ],
)
def test_what_cannot_be_made_is_refused(tmp_path, more, message):
    with pytest.raises(ConfigError, match=message):
        order(tmp_path, **more)


def test_progress_counts_files_also_those_made_before(tmp_path, quick):
    write_towns(order(tmp_path, scenes=3))
    (tmp_path / "training.tfrecord-00002-of-00003.gz").unlink()
    told = []

    write_towns(order(tmp_path, scenes=3), told.append)

    assert [event["event"] for event in told] == ["work-started", "unit-done"]
    assert (told[0]["units"], told[0]["made"]) == (3, 2)


def test_one_process_at_a_time_writes_to_a_folder(tmp_path, quick):
    write_towns(order(tmp_path))

    with locked(tmp_path / "training.towns.lock"), pytest.raises(LockedError):
        write_towns(order(tmp_path))


def test_a_request_to_stop_is_met_after_a_file(tmp_path, quick, monkeypatch):
    def check():
        raise signals.Stopped(15)

    monkeypatch.setattr(towns.signals, "raise_if_stopped", check)

    with pytest.raises(signals.Stopped):
        write_towns(order(tmp_path, scenes=3))
    assert len(quick) == 1


def test_without_sumo_nothing_is_begun(tmp_path, monkeypatch):
    monkeypatch.setattr(sumo, "PACKAGE", "no_such_package")

    with pytest.raises(SumoError, match=r"infgen\[towns"):
        write_towns(order(tmp_path / "none"))
    assert not (tmp_path / "none").exists()


@needs_sumo
@pytest.mark.slow
def test_any_number_of_processes_writes_the_same_bytes(tmp_path):
    one = write_towns(order(tmp_path / "one"))
    two = write_towns(replace(order(tmp_path / "two"), jobs=2))

    assert one.files == two.files
    for name in one.files:
        made = [(Path(each.out) / name).read_bytes() for each in (one, two)]
        assert made[0] == made[1]
        (scene,) = iter_scenes(tmp_path / "one" / name)
        assert isinstance(scene, Scene)
        assert scene.tracks.num_steps == 21
    asked = json.loads((tmp_path / "two" / "training.towns.json").read_text())
    assert asked["seed"] == 3


def test_towns_of_before_a_choice_are_basic_with_all_scenes(tmp_path, quick):
    write_towns(order(tmp_path))
    path = tmp_path / "training.towns.json"
    about = json.loads(path.read_text())
    assert about.pop("variety") == "basic"
    assert about.pop("scenes_per_town") == 0
    path.write_text(json.dumps(about))

    assert write_towns(order(tmp_path)).before == 2
    with pytest.raises(ConfigError, match="variety basic, not broad"):
        write_towns(order(tmp_path, variety="broad"))


def test_a_variety_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="variety 'wild'; expected basic or broad"):
        order(tmp_path, variety="wild")
