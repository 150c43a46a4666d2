import functools
import os
import re
import sys
import threading
import time

import dask
import distributed
import pytest

from infgen.errors import ConfigError
from pipeline.engine.locks import LockedError
from pipeline.engine.runner import RunOptions
from pipeline.engine.units import InProcess, WorkersLostError
from pipeline.workers.dask_cluster import DaskWorkers, gpu_workers, parse, select_gpus
from pipeline.workers.gpus import VISIBLE_DEVICES
from tests.clusters import Cluster

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
        ("gpu", ("gpu", "")),
        ("gpu:0,1", ("gpu", "0,1")),
        ("gpu*4", ("gpu", "*4")),
        ("gpu:0*6,1*6", ("gpu", "0*6,1*6")),
        ("tcp://host:8786", ("tcp", "//host:8786")),
        ("file:scheduler.json", ("file", "scheduler.json")),
    ],
)
def test_words_name_a_kind_of_workers(words, parts):
    assert parse(words) == parts


@pytest.mark.parametrize(
    "words",
    [
        *("", "locl", "local:0", "local:x", "tcp:", "file:"),
        *("gpu:a", "gpu:", "gpu*0", "gpu*", "gpu:0*0", "gpu:0*", "gpu:*2", "gpu:0*2*3"),
        *("gpu:0,", "gpu*2:0", "gpu:-1", "gpu:0*1.5", "gpux2"),
    ],
)
def test_other_words_are_refused_with_the_grammar_before_anything_runs(words):
    with pytest.raises(ConfigError, match=r"expected none \| local.*gpu:0\[\*N\],1\[\*N\]"):
        DaskWorkers(words)


def test_no_cluster_is_started_for_a_stage_that_must_run_here():
    with DaskWorkers("tcp://127.0.0.1:1").open() as workers:
        assert isinstance(workers.executor(here=True), InProcess)


def test_without_a_device_gpu_workers_are_refused():
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("this machine has a CUDA device")
    with (
        DaskWorkers("gpu").open() as workers,
        pytest.raises(ConfigError, match="no CUDA device"),
    ):
        workers.executor(here=False)


@pytest.mark.parametrize(
    ("wanted", "visible", "names"),
    [
        ("", None, ["0", "1", "2"]),
        ("0,2", None, ["0", "2"]),
        ("", "5,6,7", ["5", "6", "7"]),
        ("1", "5, GPU-ab12 ,7", ["GPU-ab12"]),
        ("*2", None, ["0", "0", "1", "1", "2", "2"]),
        ("0*3,2", "5,6,7", ["5", "5", "5", "7"]),
    ],
)
def test_devices_are_named_as_this_process_sees_them(monkeypatch, wanted, visible, names):
    monkeypatch.setattr("torch.cuda.device_count", lambda: 3)

    assert select_gpus(wanted, visible) == names


@pytest.mark.parametrize("wanted", ["3", "0,0", "0*2,3*2", "1*2,1"])
def test_devices_that_are_not_there_or_named_twice_are_refused(monkeypatch, wanted):
    monkeypatch.setattr("torch.cuda.device_count", lambda: 3)

    with pytest.raises(
        ConfigError, match=f"--dask gpu:{re.escape(wanted)}: expected .* from 0 to 2"
    ):
        select_gpus(wanted, None)


def test_whoever_names_a_device_twice_is_told_how_to_have_two_workers_on_it(monkeypatch):
    monkeypatch.setattr("torch.cuda.device_count", lambda: 3)

    with pytest.raises(ConfigError, match=r"; gpu:1\*N starts N workers on a device"):
        select_gpus("0,1,1", None)


@pytest.mark.parametrize(("wanted", "words"), [("*49", "gpu*49"), ("0,1*49", "gpu:0,1*49")])
def test_more_workers_than_a_device_takes_are_refused(monkeypatch, wanted, words):
    monkeypatch.setattr("torch.cuda.device_count", lambda: 3)

    with pytest.raises(ConfigError, match=f"--dask {re.escape(words)}: 49 .* expected 48"):
        select_gpus(wanted, None)


def test_workers_of_one_device_share_it_and_all_share_the_memory():
    described = gpu_workers(["0", "0", "GPU-ab12"])

    assert list(described) == ["0-0", "0-1", "GPU-ab12"]
    options = [each["options"] for each in described.values()]
    assert [each["env"][VISIBLE_DEVICES] for each in options] == ["0", "0", "GPU-ab12"]
    assert [each["resources"]["GPU"] for each in options] == [0.5, 0.5, 1.0]
    (limit,) = {each["options"]["memory_limit"] for each in described.values()}
    assert limit * 3 <= distributed.system.MEMORY_LIMIT < (limit + 1) * 3


def seen_by_this_process(dask_worker):
    share = dask_worker.state.total_resources["GPU"]
    return os.environ["CUDA_VISIBLE_DEVICES"], share, "torch" in sys.modules


@pytest.mark.slow
def test_each_gpu_worker_sees_its_own_device_before_it_imports_anything():
    web = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
    options = {"host": "127.0.0.1", **web}
    scheduler = {"cls": distributed.Scheduler, "options": options}
    workers = gpu_workers(["4", "4", "GPU-ab12"])
    assert workers["4-0"]["options"]["nthreads"] == 1

    with (
        distributed.SpecCluster(workers=workers, scheduler=scheduler) as started,
        distributed.Client(started, set_as_default=False) as client,
    ):
        found = client.run(seen_by_this_process)

    assert sorted(found.values()) == [
        ("4", 0.5, False),
        ("4", 0.5, False),
        ("GPU-ab12", 1.0, False),
    ]


@pytest.mark.slow
def test_workers_write_the_same_bytes_as_this_process(workshop):
    for number in range(6):
        workshop.text(f"{number}.txt", "word " * number)
    workshop.run()
    here = workshop.files()
    results = workshop.run(
        run_options=RunOptions(force=frozenset({"count"}), workers=DaskWorkers("local:2"))
    )

    assert {result.state for result in results.values()} == {"made"}
    assert results["count"].made == 8
    assert workshop.files() == here


@pytest.mark.slow
def test_a_unit_that_fails_or_kills_its_worker_is_recorded_and_the_rest_goes_on(workshop):
    workshop.text("c.txt", "fail")
    workshop.text("d.txt", "die")
    run_options = RunOptions(workers=DaskWorkers("local:2"), keep_going=True)

    results = workshop.run(run_options=run_options, targets=("count",))

    assert results["count"].state == "failed"
    assert results["count"].made == 2
    errors = results["count"].errors
    assert errors["c.txt"] == "ValueError: c.txt says fail"
    assert "KilledWorker" in errors["d.txt"]
    assert not list(workshop.root.store.rglob("c.txt*"))


@pytest.mark.slow
def test_a_failed_device_ends_its_worker_and_not_the_queue(workshop):
    workshop.text("c.txt", "assert")
    workshop.text("d.txt", "assert-once and no more")
    for number in range(4):
        workshop.text(f"{number}.txt", "word " * number)
    events, run_options = [], RunOptions(workers=DaskWorkers("local:2"), keep_going=True)

    results = workshop.run(run_options=run_options, targets=("count",), events=events)

    assert results["count"].made == 7
    assert list(results["count"].errors) == ["c.txt"]
    failure = results["count"].errors["c.txt"]
    assert "KilledWorker" in failure
    assert "AcceleratorError: CUDA error: device-side assert triggered" in failure
    told = [event for event in events if event["event"] == "device-failed"]
    assert {event["unit"] for event in told} == {"c.txt", "d.txt"}
    lost = [unit for e in events if e["event"] == "worker-lost" for unit in e["units"]]
    assert {"c.txt", "d.txt"} <= set(lost)


@pytest.fixture
def cluster(tmp_path):
    """``cluster(workers, **settings)``: how it is named to a run, and the cluster."""
    started = []

    def start(workers=1, environment=None, **settings):
        # One death of a worker is enough to suspect a unit.
        once = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0", **(environment or {})}
        paths = [str(path) for path in sys.path if path]
        started.append(Cluster(tmp_path, paths, environment=once, **settings))
        started[-1].start(workers)
        return started[-1].words, started[-1]

    yield start
    for cluster in started:
        cluster.stop()


def in_background(job):
    """Run a job in a thread; what it returns or raises is put in a list."""
    found = []

    def run():
        try:
            found.append(job())
        except Exception as error:
            found.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, found


def wait_for(condition, limit_s=120):
    begun = time.monotonic()
    while not condition():
        assert time.monotonic() - begun < limit_s
        time.sleep(0.02)


def done_units(workshop):
    folders = (path.parent for path in workshop.root.units("count").glob("*/manifest.json"))
    return {folder for folder in folders if folder.suffix != ".partial"}


@pytest.mark.slow
def test_a_cluster_that_is_already_there_is_used(workshop, cluster):
    words, _ = cluster()

    results = workshop.run(run_options=RunOptions(workers=DaskWorkers(words)))

    assert results["count"].made == 2


@pytest.mark.slow
def test_a_killed_worker_is_told_of_and_its_unit_begins_again(workshop, cluster):
    words, started = cluster(workers=1)
    events = []
    job = functools.partial(
        workshop.run,
        "count.sleep_s=3",
        run_options=RunOptions(workers=DaskWorkers(words)),
        events=events,
    )

    running, found = in_background(job)
    wait_for(lambda: list(workshop.root.units("count").glob("*.partial")))
    started.kill_worker(0)
    running.join(timeout=120)

    assert found[0]["count"].state == "made"
    (lost,) = [event for event in events if event["event"] == "worker-lost"]
    assert lost["units"]
    assert {each["unit"] for each in events if each["event"] == "unit-done"} >= {"a.txt"}


@pytest.mark.slow
def test_a_worker_that_fills_its_memory_is_restarted_and_told_of(workshop, cluster):
    words, _ = cluster(workers=1, memory_limit="400MiB")
    workshop.text("c.txt", "hoard")
    workshop.text("d.txt", "after it")
    events = []
    run_options = RunOptions(workers=DaskWorkers(words), keep_going=True)

    results = workshop.run(run_options=run_options, targets=("count",), events=events)

    assert results["count"].made == 3
    assert list(results["count"].errors) == ["c.txt"]
    assert "KilledWorker" in results["count"].errors["c.txt"]
    assert "filled its memory" in results["count"].errors["c.txt"]
    told = [event["event"] for event in events]
    assert told.count("worker-full") == 2, "it is tried again, alone, and no more"
    assert 0.3 < next(e for e in events if e["event"] == "worker-full")["memory_gib"] < 1.1
    assert "worker-lost" in told


@pytest.mark.slow
def test_a_unit_that_hangs_ends_with_its_time_and_the_rest_goes_on(workshop, cluster):
    words, _ = cluster(workers=1)
    workshop.text("c.txt", "hang")
    workshop.text("d.txt", "after it")
    events = []
    workers = DaskWorkers(words, unit_limit_s=3.0)

    results = workshop.run(
        run_options=RunOptions(workers=workers, keep_going=True),
        targets=("count",),
        events=events,
    )

    assert results["count"].made == 3
    assert list(results["count"].errors) == ["c.txt"]
    why = "(it took longer than --unit-timeout, 0.05 minutes)"
    assert results["count"].errors["c.txt"].endswith(why)
    assert [e["unit"] for e in events if e["event"] == "unit-timeout"] == ["c.txt"]
    assert not list(workshop.root.store.rglob("*.partial/count.json"))


@pytest.mark.slow
def test_a_worker_that_does_not_move_is_given_up_and_its_unit_begins_again(
    workshop, cluster
):
    words, started = cluster(
        workers=2, environment={"DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "15s"}
    )
    # So long that a look every 20 ms cannot miss a unit in the making.
    setting = "count.sleep_s=1"
    workshop.run(setting, targets=("count",))
    expected = workshop.files()
    for number in range(4):
        workshop.text(f"{number}.txt", "word " * number)
    run_options = RunOptions(workers=DaskWorkers(words))
    running, found = in_background(
        functools.partial(
            workshop.run, setting, run_options=run_options, targets=("count",)
        )
    )
    wait_for(lambda: list(workshop.root.units("count").glob("*.partial")))

    started.freeze_worker(0)
    running.join(timeout=400)

    assert found[0]["count"].state == "made"
    assert found[0]["count"].made == 4
    assert expected.items() <= workshop.files().items()


@pytest.mark.slow
def test_when_all_workers_are_killed_their_units_begin_again(workshop, cluster):
    for number in range(4):
        workshop.text(f"{number}.txt", "word " * number)
    words, started = cluster(workers=2)
    run_options = RunOptions(workers=DaskWorkers(words))
    job = functools.partial(
        workshop.run, "count.sleep_s=2", run_options=run_options, targets=("count",)
    )
    running, found = in_background(job)
    wait_for(lambda: done_units(workshop))

    started.kill_workers()
    running.join(timeout=400)

    assert found[0]["count"].state == "made"
    assert found[0]["count"].made == 6
    assert not list(workshop.root.store.rglob("*.partial"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("tcp://127.0.0.1:1", "scheduler tcp://127.0.0.1:1 does not answer"),
        ("file:there/is/none.json", "no Dask scheduler has written there/is/none.json"),
    ],
)
def test_a_scheduler_that_is_not_there_ends_the_run(workshop, monkeypatch, words, says):
    monkeypatch.setattr("pipeline.workers.dask_cluster.SCHEDULER_TIMEOUT_S", 0.3)
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(WorkersLostError, match=says),
    ):
        workshop.run(run_options=RunOptions(workers=DaskWorkers(words)))


@pytest.mark.slow
def test_a_lost_scheduler_ends_the_run_and_the_next_one_goes_on(workshop, cluster):
    for number in range(4):
        workshop.text(f"{number}.txt", "word " * number)
    words, started = cluster(workers=2)
    run_options = RunOptions(workers=DaskWorkers(words), keep_going=True)
    running, found = in_background(
        functools.partial(
            workshop.run, "count.sleep_s=2", run_options=run_options, targets=("count",)
        )
    )
    wait_for(lambda: done_units(workshop))

    begun = time.monotonic()
    started.kill_scheduler()
    running.join(timeout=120)
    taken_s = time.monotonic() - begun
    kept = done_units(workshop)

    assert isinstance(found[0], WorkersLostError)
    assert re.fullmatch(
        r"the Dask scheduler tcp://\S+ is lost; what is done is kept: run again when there "
        r"is one",
        str(found[0]),
    )
    assert taken_s < 45
    result = workshop.run("count.sleep_s=2", targets=("count",))["count"]
    assert result.state == "made"
    assert result.made == 6 - len(kept)


@pytest.mark.slow
def test_a_scheduler_that_hangs_ends_the_run(workshop, cluster, monkeypatch):
    monkeypatch.setattr("pipeline.workers.dask_cluster.SCHEDULER_TIMEOUT_S", 2.0)
    monkeypatch.setattr("pipeline.workers.dask_cluster.CLOSE_S", 2.0)
    words, started = cluster()
    running, found = in_background(
        functools.partial(
            workshop.run,
            "count.sleep_s=3",
            run_options=RunOptions(workers=DaskWorkers(words)),
        )
    )
    wait_for(lambda: list(workshop.root.units("count").glob("*.partial")))

    started.freeze_scheduler()
    running.join(timeout=120)

    assert isinstance(found[0], WorkersLostError)


def test_a_second_run_queues_if_told_to(workshop):
    refused, waited = [], []

    def run(run_options, done):
        try:
            done.append(
                workshop.run("count.sleep_s=1.5", run_options=run_options)["count"].state
            )
        except LockedError as error:
            done.append(error)

    first = threading.Thread(target=run, args=(RunOptions(), []))
    first.start()
    while not workshop.root.attempt("count").is_file():
        time.sleep(0.01)
    run(RunOptions(), refused)
    run(RunOptions(wait=True), waited)
    first.join()

    assert isinstance(refused[0], LockedError)
    assert waited == ["cached"]
