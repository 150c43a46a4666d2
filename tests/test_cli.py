"""The command line as a user meets it: words, tables, exit codes."""

import gzip
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cli import main
from infgen.sources.towns import builtin_records
from pipeline.settings.stages_file import DEFAULT_FILE

HERE = Path(__file__).parent
TOYS = HERE / "pipeline" / "toys"
STAGES = """\
version: 1
stages:
  count: {module: toy_count, deps: [sources], params: [count]}
  total: {module: toy_total, deps: [count], params: [total]}
  climb: {module: toy_climb, deps: [total], params: [climb]}
profiles:
  short: {count: {longest: 3}}
"""
VERBS = [
    *("run", "ingest", "build-vocab", "tokenize", "train", "rollout", "score", "report"),
    *("plan", "status", "dag", "gc", "verify", "show", "diff", "init", "doctor", "demo"),
    *("towns", "calibrate", "reference", "wosac", "export", "view", "settings", "drive"),
]


@pytest.fixture
def toys(tmp_path, monkeypatch):
    """A folder with a stages.yaml of toys and two texts, as the current one."""
    monkeypatch.syspath_prepend(str(TOYS))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    Path("stages.yaml").write_text(STAGES)
    Path("texts").mkdir()
    Path("texts/a.txt").write_text("one two three")
    Path("texts/b.txt").write_text("lorem ipsum")
    return tmp_path


@pytest.fixture
def infgen(toys, capsys):
    """``infgen("run", ...)`` gives (exit code, output, error output)."""

    def call(*words):
        with pytest.raises(SystemExit) as left:
            main([str(word) for word in words])
        out, err = capsys.readouterr()
        return left.value.code or 0, out, err

    return call


RUN = ("run", "--root", "R", "--records", "texts/*.txt")


def test_a_run_prints_what_it_made_and_then_that_it_is_there(infgen):
    code, out, err = infgen(*RUN)
    assert code == 0
    assert out.count("made") >= 3
    assert "count: made; files 2, words 5" in err

    code, out, _ = infgen("run", "--root", "R")
    assert code == 0
    assert out.count("cached") == 3


def test_a_run_of_one_stage_makes_what_it_needs_and_no_more(infgen):
    _, out, _ = infgen("run", "total", *RUN[1:], "--json")

    assert [stage["stage"] for stage in json.loads(out)["stages"]] == ["count", "total"]


def test_a_dry_run_makes_nothing(infgen):
    code, out, _ = infgen(*RUN, "-n")

    assert code == 0
    assert out.count("missing") == 3
    assert not Path("R/store").exists()


def test_status_as_json_has_just_the_stages_with_state_and_why(infgen):
    infgen(*RUN)
    code, out, _ = infgen("status", "--root", "R", "--json", "-s", "total.times=3")

    found = json.loads(out)
    assert code == 0
    assert list(found) == ["stages"]
    told = {each["stage"]: (each["state"], each["why"]) for each in found["stages"]}
    assert told["count"] == ("cached", "")
    assert told["total"] == ("stale", "total.times 1.0 -> 3.0")
    assert told["climb"] == ("stale", "input total: total.times 1.0 -> 3.0")


def test_status_check_tells_by_its_exit_code(infgen):
    assert infgen("status", "--check", *RUN[1:])[0] == 3
    infgen(*RUN)
    assert infgen("status", "--check", "--root", "R")[0] == 0
    assert infgen("status", "--check", "--root", "R", "-s", "climb.steps=2")[0] == 3


def test_plan_says_what_a_run_would_do(infgen):
    infgen(*RUN)

    _, out, _ = infgen("plan", "--root", "R", "-s", "climb.steps=2")

    assert "climb.steps 5 -> 2" in out


def test_a_failed_unit_is_named_and_the_exit_code_is_1(infgen):
    Path("texts/a.txt").write_text("fail")

    code, out, err = infgen(*RUN)

    assert code == 1
    assert "count: a.txt: ValueError: a.txt says fail" in err
    assert "Traceback" not in out + err
    assert "skipped" in out


def test_a_failed_device_ends_a_run_with_a_line_and_exit_code_1(infgen):
    Path("texts/a.txt").write_text("assert")

    code, out, err = infgen(*RUN, "--keep-going")

    assert code == 1
    assert "infgen: unit a.txt: the device (of " in err
    assert "CUDA error: device-side assert triggered; what is done is kept" in err
    assert "Traceback" not in out + err


def test_force_and_from_make_again(infgen):
    infgen(*RUN)

    def states(*words):
        out = infgen("run", "--root", "R", "--json", *words)[1]
        return [stage["state"] for stage in json.loads(out)["stages"]]

    assert states("total", "-f") == ["cached", "made"]
    assert states("-f") == ["made", "made", "made"]
    assert states("--from", "total") == ["cached", "made", "made"]
    assert infgen("run", "--root", "R", "--from", "none")[0] == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "totl"], "did you mean 'total'"),
        (["run", "-s", "total.tims=2"], "did you mean 'times'"),
        (["run", "-s", "total"], "expected section.key=value"),
        (["run", "--profile", "shrt"], "did you mean 'short'"),
        (["run", "--dask", "lokal"], "expected none | local"),
        (["run", "--records", "none/*"], "no records match"),
        (["run", "--file", "none.yaml"], "none.yaml is missing"),
        (["status", "--records", "none/*"], "no records match"),
        (["run", "--arms", "smart"], "expected --preset NAME beside it"),
        (["run", "--seeds", "3"], "expected --preset NAME beside it"),
        (["show", "0123456"], "starts with '0123456'"),
        (["diff", "0123456", "total"], "starts with '0123456'"),
    ],
)
def test_wrong_words_are_one_line_and_exit_code_2(infgen, words, message):
    more = [] if {"--records", "show", "diff"} & set(words) else RUN[3:]
    Path("R/store").mkdir(parents=True)

    code, _, err = infgen(*words, "--root", "R", *more)

    assert code == 2
    assert message in err
    assert err.startswith("infgen: ")
    assert "Traceback" not in err


def test_an_unknown_option_is_exit_code_2(infgen):
    assert infgen("run", "--rot", "R")[0] == 2


def test_damage_is_found_and_is_exit_code_1(infgen):
    infgen(*RUN)
    assert infgen("verify", "--root", "R", "--full")[:2] == (
        0,
        "all files are as their manifests say\n",
    )
    (file,) = Path("R/store/total").glob("*/total.json")
    file.write_text("1\n")

    code, out, _ = infgen("verify", "--root", "R")

    assert code == 1
    assert "total.json holds 2 bytes" in out
    assert json.loads(infgen("verify", "--root", "R", "--json")[1])["damage"]


def test_a_damaged_manifest_is_one_line_and_exit_code_1(infgen):
    infgen(*RUN)
    (manifest,) = Path("R/store/total").glob("*/manifest.json")
    manifest.write_text("{")

    code, _, err = infgen("run", "--root", "R")

    assert code == 1
    assert "manifest.json is damaged" in err


def test_show_and_diff_tell_how_things_were_made(infgen):
    infgen(*RUN)
    infgen("run", "--root", "R", "-s", "total.times=3")
    keys = [path.parent.name for path in Path("R/store/total").glob("*/manifest.json")]

    about = json.loads(infgen("show", "total", "--root", "R")[1])
    assert about["settings"] == {"total": {"times": 3.0, "refuse": False}}
    found = json.loads(infgen("diff", *keys, "--root", "R", "--json")[1])["differences"]
    assert "settings.total.times" in [what for what, *_ in found]
    assert "settings.total.times" in infgen("diff", *keys, "--root", "R")[1]


def test_gc_lists_first_and_removes_only_if_told_to(infgen):
    infgen(*RUN)
    infgen("run", "--root", "R", "-s", "total.times=3")
    before = sorted(Path("R/store").rglob("*"))

    _, out, _ = infgen("gc", "--root", "R")
    assert "to remove with --yes" in out
    assert sorted(Path("R/store").rglob("*")) == before
    assert (
        len(json.loads(infgen("gc", "--root", "R", "--yes", "--json")[1])["garbage"]) == 5
    )
    assert "0.0 MB to remove" in infgen("gc", "--root", "R")[1]


def test_the_graph_is_shown_as_text_and_as_a_chart(infgen):
    assert "total        <- count" in infgen("dag")[1]
    assert infgen("dag", "--mermaid")[1].startswith("flowchart LR\n  sources --> count\n")


def test_init_writes_the_packaged_file_once(infgen):
    Path("stages.yaml").unlink()

    code, out, _ = infgen("init")
    assert (code, "`infgen run` in this folder uses it" in out) == (0, True)
    assert Path("stages.yaml").read_bytes() == DEFAULT_FILE.read_bytes()
    assert infgen("init")[0] == 2
    assert "use it with --file mine.yaml" in infgen("init", "mine.yaml")[1]


def test_doctor_finds_this_machine_fit(infgen):
    code, out, _ = infgen("doctor", "--root", "R", "--json")

    assert code == 0
    assert {"python", "locks", "disk"} <= {c["what"] for c in json.loads(out)["checks"]}


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_helps_with_an_example(infgen, verb):
    code, out, _ = infgen(verb, "--help")

    assert code == 0
    assert "Example: infgen" in out


@pytest.fixture
def one_bad(tmp_path):
    """A file of the built-in records, one of them with a flipped bit."""
    source = min(builtin_records(), key=lambda path: path.stat().st_size)
    data = bytearray(gzip.decompress(source.read_bytes()))
    data[500] ^= 1
    path = tmp_path / source.name
    path.write_bytes(gzip.compress(bytes(data)))
    return path


def test_bad_records_are_counted_located_and_too_many_are_exit_code_3(infgen, one_bad):
    Path("stages.yaml").unlink()  # The real stages.

    code, out, err = infgen("ingest", one_bad, "--root", "R", "--json")
    assert code == 3
    (stage,) = json.loads(out)["stages"]
    assert (stage["state"], stage["report"]["quarantined"]) == ("made", 1)
    assert "more than --max-bad 0.001" in err
    table = next(Path("R/store/ingest").glob("*/quarantine.parquet")).resolve()
    assert str(table) in err
    assert f"  {one_bad.name}, record 0: data checksum does not match" in err

    code, _, err = infgen("ingest", "--root", "R", "--max-bad", "0.5")
    assert code == 0
    assert "are quarantined" in err


def start(*words, **environ):
    """Start ``infgen`` in a process of its own."""
    path = os.pathsep.join([str(HERE.parent), str(TOYS)])
    return subprocess.Popen(
        [sys.executable, "-m", "infgen", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path, **environ},
    )


def wait_for(path, lines=0):
    """Wait until a file is there, and has so many lines."""
    deadline = time.monotonic() + 30
    while not path.exists() or len(path.read_text().splitlines()) < lines:
        assert time.monotonic() < deadline, f"{path} never came"
        time.sleep(0.01)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_a_run_whole_with_its_own_exit_code(toys, number, code):
    running = start(*RUN, "-s", "count.sleep_s=20")
    wait_for(toys / "R/store/count/attempt.json")
    time.sleep(0.2)
    running.send_signal(number)
    _, err = running.communicate(timeout=20)

    assert running.returncode == code
    assert "Traceback" not in err
    assert not list(Path("R/store").rglob("*.partial"))


def test_a_signal_lets_a_resuming_stage_save_where_it_is(toys):
    running = start(*RUN, "-s", "climb.sleep_s=0.2", "-s", "climb.steps=200")
    wait_for(toys / "R/store/climb/begun-at")
    time.sleep(0.7)
    running.send_signal(signal.SIGTERM)
    running.communicate(timeout=20)
    again = start("run", "--root", "R", "-s", "climb.sleep_s=0.2")
    wait_for(toys / "R/store/climb/begun-at", lines=2)
    time.sleep(0.7)
    again.send_signal(signal.SIGTERM)
    again.communicate(timeout=20)

    assert running.returncode == again.returncode == 143
    first, second = (toys / "R/store/climb/begun-at").read_text().split()
    assert int(first) == 0 < int(second)


def test_a_second_run_is_turned_away_with_75_and_told_by_whom(toys):
    first = start(*RUN, "-s", "count.sleep_s=20")
    wait_for(toys / "R/store/count/attempt.json")
    second = start(*RUN, "-s", "count.sleep_s=20")
    _, err = second.communicate(timeout=20)
    first.kill()
    first.communicate()

    assert second.returncode == 75
    assert f"process {first.pid} on {os.uname().nodename} since" in err
    assert "--wait" in err


HEAVY = ("torch", "zarr", "dask", "distributed", "polars", "matplotlib")
WATCHED = """
import sys, cli
try:
    cli.main(sys.argv[1:])
except SystemExit as left:
    code = left.code or 0
heavy = [name for name in {heavy} if name in sys.modules]
sys.exit(code or (f"imported {{heavy}}" if heavy else 0))
"""


@pytest.mark.parametrize(
    "words",
    [
        ["--help"],
        ["dag"],
        ["status", "--root", "R", "--records", "texts/*.txt"],
        ["plan", "--root", "R", "--records", "texts/*.txt"],
    ],
    ids=lambda words: words[0],
)
def test_looking_imports_nothing_heavy(toys, words):
    Path("stages.yaml").unlink()  # The real stages.
    code = WATCHED.format(heavy=HEAVY)
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(HERE.parent)},
        check=False,
    )

    assert done.returncode == 0, done.stderr
