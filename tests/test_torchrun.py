"""``torchrun -m infgen train``: one command in several processes."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

HERE = Path(__file__).parents[1]
TINY = ("--records", "builtin", "--profile", "tiny", "-s", "model.dropout=0")


def run(words, processes=1, code=0):
    """Run a command of ours, in so many processes; return what it printed."""
    launcher = ["-m", "torch.distributed.run", "--standalone"]
    launcher += [f"--nproc-per-node={processes}"]
    done = subprocess.run(
        [sys.executable, *(launcher if processes > 1 else ()), "-m", "infgen", *words],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": str(HERE), "OMP_NUM_THREADS": "1"},
        check=False,
    )
    assert (done.returncode == 0) == (code == 0), done.stderr
    return done


@pytest.mark.slow
def test_two_processes_make_the_stages_once_and_train_together(tmp_path):
    root = tmp_path / "R"
    words = ["train", "--root", str(root), *TINY, "--json"]

    made = json.loads(run(words, processes=2).stdout)["stages"]

    assert [stage["state"] for stage in made] == ["made"] * len(made)
    (unit,) = (root / "store" / "train" / "units").iterdir()
    report = json.loads((unit / "run.json").read_text())["report"]
    assert report["processes"] == 2
    again = json.loads(run(words, processes=2).stdout)["stages"]
    assert [stage["state"] for stage in again] == ["cached"] * len(made)


def start_pair(words):
    """Start a command twice, as two machines would: the first one hosts the meeting."""
    with socket.socket() as door:
        door.bind(("127.0.0.1", 0))
        port = door.getsockname()[1]
    place = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    return [
        subprocess.Popen(
            [sys.executable, "-m", "infgen", *words],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(HERE), **place, "RANK": str(rank)},
        )
        for rank in range(2)
    ]


@pytest.mark.slow
def test_a_pair_that_is_told_to_stop_saves_and_leaves_with_143(tmp_path):
    words = ["train", "--root", str(tmp_path), *TINY, "-s", "train.steps=100000"]
    pair = start_pair(words)
    try:
        units = tmp_path / "store" / "train" / "units"
        deadline = time.monotonic() + 240
        while not list(units.glob("*.partial/checkpoint.json")):
            assert time.monotonic() < deadline
            assert [process.poll() for process in pair] == [None, None]
            time.sleep(0.05)
        pair[0].send_signal(signal.SIGTERM)
        said = [process.communicate(timeout=60)[1] for process in pair]
    finally:
        for process in pair:
            process.kill()
            process.communicate()

    assert [process.returncode for process in pair] == [143, 143], said
    assert len(list(units.glob("*.partial/checkpoint-*"))) == 1


@pytest.mark.slow
def test_wrong_words_fail_once(tmp_path):
    words = ["train", "--root", str(tmp_path), "-s", "trian.steps=3"]

    done = run(words, processes=2, code=1)

    assert done.stderr.count("did you mean 'train'?") == 1
