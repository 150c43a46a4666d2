"""When checkpoints are due, what is told, and the curves for TensorBoard."""

import json
import sys
from dataclasses import replace

import pytest
import torch

from infgen.errors import ConfigError
from infgen.model.training.losses import Term
from pipeline.stages.train.optimizer_step import StepResult
from pipeline.stages.train.recorder import TrainingRecorder
from pipeline.stages.train.setup import begin
from pipeline.stages.train.tensorboard import EventFiles
from pipeline.stages.train.throughput import ThroughputMeter
from pipeline.storage.checkpoint import POINTER


@pytest.fixture
def stepped():
    one = torch.ones(())
    terms = {"motion": Term(*(one * n for n in (6.0, 3.0, 2.0, 1.0, 0.0)))}
    return StepResult(terms, 0.5, torch.tensor([2 * 1.3862944, 2.0]))


@pytest.fixture
def recorder(setup, books, quiet):
    """``journal(first=0, progress, **settings)`` of a network that stays as it is."""

    def open_at(first=0, progress=quiet, **changes):
        changed = replace(setup, train=replace(setup.train, **changes))
        return TrainingRecorder(changed, begin(changed, *books), first, progress)

    return open_at


def saved(setup):
    pointer = setup.folder / POINTER
    return json.loads(pointer.read_text())["step"] if pointer.exists() else None


def test_checkpoints_come_by_steps(recorder, setup, stepped):
    with recorder(checkpoint_every_steps=2, checkpoint_minutes=0.0) as kept:
        found = []
        for done in (1, 2, 3):
            kept.add(done, stepped)
            kept.keep_up(stepped)
            found.append(saved(setup))

    assert found == [None, 2, 2]


def test_checkpoints_come_by_time(recorder, setup, stepped):
    with recorder(checkpoint_every_steps=0, checkpoint_minutes=1e-9) as kept:
        for done in (1, 2):
            kept.add(done, stepped)
            kept.keep_up(stepped)
            assert saved(setup) == done


def test_checkpoints_need_not_come_at_all(recorder, setup, stepped):
    with recorder(checkpoint_every_steps=0, checkpoint_minutes=0.0) as kept:
        kept.add(1, stepped)
        kept.keep_up(stepped)

    assert saved(setup) is None


def test_progress_tells_loss_speed_and_memory(recorder, stepped, monkeypatch):
    monkeypatch.setattr("pipeline.stages.train.throughput.TELL_EVERY_S", 0.0)
    told = []

    def tell(done, total, note=""):
        told.append((done, total, note))

    with recorder(progress=tell) as kept:
        kept.add(1, stepped)
        kept.keep_up(stepped)

    ((done, total, note),) = told
    assert (done, total) == (1, 6)
    assert note.startswith("loss 2.000, ")
    assert note.endswith(" GiB")


def test_perplexity_is_that_of_the_mean_surprise(stepped):
    assert stepped.perplexity == pytest.approx(4.0)


def test_pace_is_measured_since_it_was_told_last(tmp_path, monkeypatch):
    now = [10.0]
    monkeypatch.setattr("pipeline.stages.train.throughput.time.monotonic", lambda: now[0])
    throughput = ThroughputMeter(tmp_path / "pace.jsonl", steps=100, first=5, scenes=4)
    told = []

    def tell(done, total, note=""):
        told.append(note)

    now[0] = 12.0
    assert throughput.note(10)["scenes_per_s"] == 10.0  # 20 scenes in 2 s
    now[0] = 16.0
    assert throughput.due(11)
    throughput.tell(11, 1.5, tell)
    assert told[0].startswith("loss 1.500, 4 scenes/s")  # 24 scenes in 6 s
    assert not throughput.due(12)
    assert throughput.due(100)
    now[0] = 20.0
    assert throughput.overall(30) == 10.0  # 100 scenes in 10 s


def test_event_files_hold_every_number_once(tmp_path):
    records = pytest.importorskip("tensorboardX.proto.event_pb2")
    with EventFiles(tmp_path, first=3) as files:
        files.add("train", 4, {"step": 4, "motion": 1.5, "bins": {"count": [1]}})
        files.add("run", 4, {"scenes_per_s": 2})

    (path,) = tmp_path.iterdir()
    found = {}
    data = path.read_bytes()
    while data:  # Length, its checksum, the record, its checksum.
        length = int.from_bytes(data[:8], "little")
        event = records.Event.FromString(data[12 : 12 + length])
        for value in event.summary.value:
            found[value.tag] = (event.step, value.simple_value)
        data = data[16 + length :]
    assert found == {"train/motion": (4, 1.5), "run/scenes_per_s": (4, 2.0)}


def test_a_run_writes_event_files_where_it_is_asked_to(recorder, setup, stepped):
    pytest.importorskip("tensorboardX")
    with recorder(tensorboard=True) as kept:
        kept.add(1, stepped)

    assert len(list((setup.folder / "run" / "tensorboard").iterdir())) == 1


def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)

    with pytest.raises(ConfigError, match=r"pip install 'infgen\[tensorboard\]'"):
        EventFiles(tmp_path, first=0)
