"""Tables are read in a process of its own, which damaged ones may end."""

import io
import json
import os
import signal
import sys

import numpy as np
import polars as pl
import pytest

from infgen.sources.argoverse2 import table_process
from infgen.sources.argoverse2.table_process import TableProcess, serve
from infgen.sources.argoverse2.tables import FLOAT, PARQUET, TEXT, read_table
from infgen.sources.tfrecord import RecordError

COLUMNS = {"x": FLOAT, "name": TEXT}


@pytest.fixture(scope="module")
def table():
    file = io.BytesIO()
    pl.DataFrame({"x": [1.5, -2.0], "name": ["a", "über"]}).write_parquet(file)
    return file.getvalue()


@pytest.fixture
def reader():
    """A process that reads tables, not started yet."""
    reader = TableProcess()
    yield reader
    reader.end()


def test_it_reads_what_is_read_here(reader, table):
    found = reader.read(PARQUET, table, COLUMNS)

    assert found["x"].tolist() == [1.5, -2.0]
    assert found["name"].tolist() == ["a", "über"]
    for name, values in read_table(PARQUET, table, COLUMNS).items():
        assert np.array_equal(found[name], values)
        assert found[name].dtype == values.dtype


def test_what_is_wrong_with_a_table_is_said(reader, table):
    with pytest.raises(RecordError, match="not a usable Parquet table"):
        reader.read(PARQUET, table[:40], COLUMNS)
    with pytest.raises(RecordError, match="column name is of type String"):
        reader.read(PARQUET, table, {"name": FLOAT})

    assert reader.read(PARQUET, table, COLUMNS)["x"].tolist() == [1.5, -2.0]


def test_a_table_that_ends_the_reader_is_refused(table):
    reader = TableProcess(command=(sys.executable, "-c", "import os; os.abort()"))

    with pytest.raises(RecordError, match=r"Parquet table: reading it ended .*\(-6\)"):
        reader.read(PARQUET, table, COLUMNS)
    assert reader.process is None


def test_a_reader_that_something_else_ended_is_started_again(reader, table):
    reader.read(PARQUET, table, COLUMNS)
    first = reader.process
    os.kill(first.pid, signal.SIGKILL)
    first.wait()

    assert reader.read(PARQUET, table, COLUMNS)["x"].tolist() == [1.5, -2.0]
    assert reader.process is not first


def test_the_answer_to_an_interrupted_request_is_not_taken_for_the_next(
    reader, table, monkeypatch
):
    def interrupted(process, about, data):
        process.stdin.write(data)
        raise KeyboardInterrupt

    ask = table_process._ask
    monkeypatch.setattr(table_process, "_ask", interrupted)
    with pytest.raises(KeyboardInterrupt):
        reader.read(PARQUET, table, COLUMNS)
    assert reader.process is None

    monkeypatch.setattr(table_process, "_ask", ask)
    assert reader.read(PARQUET, table, COLUMNS)["x"].tolist() == [1.5, -2.0]


def test_one_process_reads_all_tables_and_ends_with_its_input(reader, table):
    for _ in range(3):
        reader.read(PARQUET, table, COLUMNS)
    process = reader.process

    process.stdin.close()

    assert process.wait(timeout=20) == 0
    process.stdout.close()


def test_requests_are_answered_in_order(tmp_path):
    def read(kind, data, columns):
        if kind == "bad":
            raise RecordError("it is bad")
        return {name: np.frombuffer(data, np.uint8) for name in columns}

    asked, answered = tmp_path / "requests", tmp_path / "answers"
    asked.write_bytes(
        b'{"kind": "bad", "columns": {}, "bytes": 1}\n!'
        b'{"kind": "good", "columns": {"x": "float"}, "bytes": 2}\n\x05\x06'
    )
    with asked.open("rb") as requests, answered.open("wb") as answers:
        serve(read, requests, answers)

    first, second, data = answered.read_bytes().split(b"\n", 2)
    assert json.loads(first) == {"error": "it is bad"}
    column = {"name": "x", "type": "|u1", "rows": 2, "words": []}
    assert json.loads(second) == {"columns": [column], "bytes": 2}
    assert data == b"\x05\x06"
