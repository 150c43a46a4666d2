"""The schedule of a training run, and its log."""

from dataclasses import replace

import pytest

from infgen.config import TrainSettings
from pipeline.train_log import TrainLog, read_log
from pipeline.training import learning_rate


def test_the_rate_rises_then_falls_as_half_a_cosine():
    how = TrainSettings(steps=110, warmup_steps=10, learning_rate=1.0)

    rates = [learning_rate(how, step) for step in range(110)]

    assert rates[0] == pytest.approx(0.1)
    assert rates[9] == rates[10] == pytest.approx(1.0)
    assert rates[60] == pytest.approx(0.5)
    assert 0 <= rates[-1] < 0.001
    assert learning_rate(replace(how, warmup_steps=0), 0) == 1.0


def test_a_log_forgets_what_lies_beyond_the_checkpoint(tmp_path):
    path = tmp_path / "train.jsonl"
    path.write_text('{"step": 1}\n{"step": 2}\n{"step": 3}\n{"ste')

    log = TrainLog(path, first=2)
    log.add({"step": 3, "motion": 1.0})
    assert [line["step"] for line in read_log(path)] == [1, 2]
    log.flush()

    assert read_log(path)[-1] == {"step": 3, "motion": 1.0}
