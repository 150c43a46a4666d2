import os
import subprocess
import sys
import threading
import time

import pytest

from infgen.config import ConfigError
from pipeline.cluster import Workers, parse
from pipeline.locks import LockedError
from pipeline.runner import Orders
from pipeline.work import InProcess

# Dask leaves sockets and child processes to the garbage collector when it closes.
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("local", ("local", "")),
        ("local:4", ("local", "4")),
        ("gpu:0,1", ("gpu", "0,1")),
        ("tcp://host:8786", ("tcp", "//host:8786")),
        ("file:scheduler.json", ("file", "scheduler.json")),
    ],
)
def test_words_name_a_kind_of_workers(words, parts):
    assert parse(words) == parts


@pytest.mark.parametrize(
    "words", ["", "locl", "local:0", "local:x", "gpu:a", "tcp:", "file:"]
)
def test_other_words_are_refused_before_anything_runs(words):
    with pytest.raises(ConfigError, match=r"expected none \| local"):
        Workers(words)


def test_no_cluster_is_started_for_a_stage_that_must_run_here():
    with Workers("tcp://127.0.0.1:1") as workers:
        assert isinstance(workers.executor(here=True), InProcess)


def test_without_a_device_gpu_workers_are_refused():
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("this machine has a CUDA device")
    with Workers("gpu") as workers, pytest.raises(ConfigError, match="no CUDA device"):
        workers.executor(here=False)


@pytest.mark.slow
def test_workers_write_the_same_bytes_as_this_process(workshop):
    for number in range(6):
        workshop.text(f"{number}.txt", "word " * number)
    workshop.run()
    here = workshop.files()
    results = workshop.run(orders=Orders(force=frozenset({"count"}), workers="local:2"))

    assert {result.state for result in results.values()} == {"made"}
    assert results["count"].made == 8
    assert workshop.files() == here


@pytest.mark.slow
def test_a_unit_that_fails_or_kills_its_worker_is_recorded_and_the_rest_goes_on(workshop):
    workshop.text("c.txt", "fail")
    workshop.text("d.txt", "die")
    orders = Orders(workers="local:2", keep_going=True)

    results = workshop.run(orders=orders, targets=("count",))

    assert results["count"].state == "failed"
    assert results["count"].made == 2
    errors = results["count"].errors
    assert errors["c.txt"] == "ValueError: c.txt says fail"
    assert "KilledWorker" in errors["d.txt"]
    assert not list(workshop.root.store.rglob("c.txt*"))


SCHEDULER = """
import sys, time
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        print(cluster.scheduler_address, flush=True)
        time.sleep(60)
"""


@pytest.mark.slow
def test_a_cluster_that_is_already_there_is_used(workshop):
    path = os.pathsep.join([str(p) for p in sys.path if p])
    process = subprocess.Popen(
        [sys.executable, "-c", SCHEDULER],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    try:
        address = process.stdout.readline().strip()
        results = workshop.run(orders=Orders(workers=address))
    finally:
        process.kill()
        process.communicate()

    assert results["count"].made == 2


def test_a_second_run_queues_if_told_to(workshop):
    refused, waited = [], []

    def run(orders, done):
        try:
            done.append(workshop.run("count.sleep_s=1.5", orders=orders)["count"].state)
        except LockedError as error:
            done.append(error)

    first = threading.Thread(target=run, args=(Orders(), []))
    first.start()
    while not workshop.root.attempt("count").is_file():
        time.sleep(0.01)
    run(Orders(), refused)
    run(Orders(wait=True), waited)
    first.join()

    assert isinstance(refused[0], LockedError)
    assert waited == ["cached"]
