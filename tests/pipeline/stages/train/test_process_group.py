"""Several processes train as one: real ones, that talk through gloo."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from pipeline.stages.train.launch import joined
from pipeline.stages.train.process_group import PeerError, ProcessGroup, device_of
from pipeline.stages.train.ranks import Rank, own_rank
from pipeline.stages.train.stage import work
from pipeline.stages.train.train_log import read_log
from pipeline.storage.checkpoint import POINTER
from pipeline.storage.weights import read_tensors

HERE = Path(__file__).parents[4]
LONGEST_S = 240
SCRIPT = """
import json, os, sys, traceback
from pathlib import Path
from infgen.settings import build
from pipeline.engine import signals
from pipeline.stages.train.launch import joined, leave
from pipeline.engine.stage import Unit
from pipeline.stages.train.stage import STAGE, work

task, target, settings = json.loads(sys.argv[1])
settings = {k: build(STAGE.settings[k], v, k) for k, v in settings.items()}


def tell(done, total, note=""):
    print(done, flush=True)
    signals.raise_if_stopped()


code = 0
try:
    with joined(os.environ) as first, signals.handling_signals():
        if first and task:
            with signals.deferred():
                work(Unit("weights", {}, task), Path(target), settings, tell)
except BaseException:
    traceback.print_exc()
    code = 1
leave(code, os.environ)
"""


def free_port():
    with socket.socket() as door:
        door.bind(("127.0.0.1", 0))
        return door.getsockname()[1]


@pytest.fixture
def how(train_settings):
    """Settings of a run of four scenes a step, without dropout."""
    return {
        **train_settings,
        "model": replace(train_settings["model"], dropout=0.0),
        "train": replace(
            train_settings["train"],
            steps=4,
            batch_scenes=4,
            learning_rate=2e-4,
            peer_timeout_s=60.0,
        ),
    }


@pytest.fixture
def start(train_unit, how):
    """``start(folder, count, **changes)`` begins that run in so many processes."""
    begun = []

    def start_in(folder, count=2, task=None, **changes):
        changed = {**how, "train": replace(how["train"], **changes)}
        plain = {name: asdict(value) for name, value in changed.items()}
        given = dict(train_unit.task) if task is None else task
        port = free_port()
        for rank in range(count):
            place = {
                "RANK": str(rank),
                "LOCAL_RANK": str(rank),
                "WORLD_SIZE": str(count),
                "MASTER_ADDR": "127.0.0.1",
                "MASTER_PORT": str(port),
            }
            words = json.dumps([given, str(folder), plain])
            begun.append(
                subprocess.Popen(
                    [sys.executable, "-c", SCRIPT, words],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                    env={**os.environ, **place, "OMP_NUM_THREADS": "1"},
                    cwd=HERE,
                )
            )
        return begun[-count:]

    yield start_in
    for process in begun:
        process.kill()
        process.communicate()


def wait(processes):
    """Exit codes and error outputs."""
    said = [process.communicate(timeout=LONGEST_S)[1] for process in processes]
    return [process.returncode for process in processes], said


def wait_for_step(processes, folder, step):
    deadline = time.monotonic() + LONGEST_S
    while not (folder / POINTER).exists() or (
        json.loads((folder / POINTER).read_text())["step"] < step
    ):
        assert time.monotonic() < deadline
        assert all(process.poll() is None for process in processes)
        time.sleep(0.01)


@pytest.mark.slow
def test_two_processes_end_with_the_weights_of_one(start, how, train_unit, quiet, tmp_path):
    two = start(tmp_path / "two")
    work(train_unit, tmp_path / "one", how, quiet)
    codes, said = wait(two)

    assert codes == [0, 0], said
    one, other = (
        read_tensors(tmp_path / name / "model.safetensors") for name in ("one", "two")
    )
    for name, value in one.items():
        torch.testing.assert_close(other[name], value, atol=1e-5, rtol=0)
    logs = [read_log(tmp_path / name / "train.jsonl") for name in ("one", "two")]
    for line, other_line in zip(*logs, strict=True):
        assert line.keys() == other_line.keys()
        if "motion" in line:
            assert other_line["motion"] == pytest.approx(line["motion"], rel=1e-4)
            assert other_line["motion_count"] == line["motion_count"]


@pytest.mark.slow
def test_a_stopped_pair_saves_once_and_goes_on(start, tmp_path):
    pair = start(tmp_path, steps=100_000, checkpoint_every_steps=1)
    wait_for_step(pair, tmp_path, 2)
    pair[0].send_signal(signal.SIGTERM)  # The other one hears of it from the first.
    codes, said = wait(pair)

    assert [code for code in codes if code == 0] == []
    assert "stopped by SIGTERM" in said[0]
    step = json.loads((tmp_path / POINTER).read_text())["step"]
    assert len(list(tmp_path.glob("checkpoint-*"))) == 1

    codes, said = wait(start(tmp_path, steps=step + 1))
    assert codes == [0, 0], said


@pytest.mark.slow
def test_a_process_that_dies_makes_the_run_fail_and_keeps_its_weights(start, tmp_path):
    pair = start(tmp_path, steps=100_000, checkpoint_every_steps=0, checkpoint_minutes=0.0)
    pair[0].stdout.readline()  # At least one step is done.
    pair[1].kill()
    codes, said = wait(pair)

    assert codes[0] == 1
    assert "PeerError: process 0 of 2 lost another one" in said[0]
    assert json.loads((tmp_path / POINTER).read_text())["step"] >= 1


@pytest.mark.slow
def test_a_first_process_with_nothing_to_train_sends_the_others_home(start, tmp_path):
    codes, said = wait(start(tmp_path, task={}))

    assert codes == [0, 0], said


def test_alone_nothing_is_added_up():
    values = torch.tensor([1.0, 2.0])

    ProcessGroup().add_up(values)
    ProcessGroup().check_same(7, "steps")

    assert values.tolist() == [1.0, 2.0]
    assert ProcessGroup().any(True)
    assert not ProcessGroup().any(False)


@pytest.mark.parametrize(
    ("local", "gpus", "device"),
    [(3, 8, "cuda:3"), (3, 1, "cuda:0"), (5, 4, "cuda:1"), (2, 0, "cpu")],
)
def test_a_process_has_a_gpu_among_those_it_sees(local, gpus, device):
    assert device_of(Rank(number=local, count=8, local=local), gpus) == torch.device(device)


def test_without_torchrun_there_is_one_process():
    with joined({}) as first:
        assert first
        assert own_rank() == Rank()


@pytest.mark.parametrize("count", [1, 2])
def test_a_process_leaves_with_its_code_after_all_that_is_due(count):
    words = (
        "import atexit; from pipeline.stages.train.launch import leave; "
        f"atexit.register(print, 'over'); "
        f"leave(7, {{'RANK': '0', 'WORLD_SIZE': '{count}'}})"
    )

    done = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, cwd=HERE, check=False
    )

    assert (done.returncode, done.stdout) == (7, "over\n"), done.stderr


def test_an_error_among_processes_is_one_of_ours():
    assert issubclass(PeerError, ValueError)
