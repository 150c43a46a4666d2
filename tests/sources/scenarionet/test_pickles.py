"""A pickle runs nothing, whatever is in it: plain data comes back, all else is refused."""

import io
import os
import pickle
import struct
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.sources.scenarionet.pickles import array, pickled, unpickle
from infgen.sources.tfrecord import RecordError

NUMBERS = {
    "double": np.arange(6.0).reshape(2, 3),
    "single": np.arange(3, dtype=np.float32),
    "truth": np.array([True, False]),
    "columns": np.asfortranarray(np.arange(6).reshape(2, 3)),
    "big end": np.array([1, 2], ">i4"),
    "empty": np.zeros((0, 3)),
}
SOUND = pickle.dumps({"a": [1, 2.5, None], "b": np.arange(3.0), "c": {"d": (1,)}}, 4)


class Runs:
    """Leaves a file behind when it is unpickled by anything that runs pickles."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize("name", NUMBERS)
def test_arrays_come_back_as_numpy_wrote_them(name, protocol):
    found = unpickle(pickle.dumps({"x": NUMBERS[name]}, protocol))["x"]

    np.testing.assert_array_equal(array(found, NUMBERS[name].dtype), NUMBERS[name])


@pytest.mark.parametrize("core", ["numpy.core", "numpy._core"])
def test_arrays_of_old_and_new_numpy_are_read(core):
    data = pickle.dumps(np.arange(3.0), 2)
    data = data.replace(b"numpy._core", core.encode()).replace(b"numpy.core", core.encode())

    assert array(unpickle(data)).tolist() == [0, 1, 2]


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_sets_come_back(protocol):
    assert unpickle(pickle.dumps({"x": {"a", "b"}}, protocol)) == {"x": {"a", "b"}}


def test_plain_containers_and_scalars_come_back():
    value = {"a": [1, -(2**70), "é", b"x", None, True], "b": {1, "c"}, "d": ((), (1, 2.5))}

    assert unpickle(pickled(value)) == value
    assert unpickle(pickled({"x": np.float32(1.5), "y": np.bool_(True)})) == {
        "x": 1.5,
        "y": True,
    }


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_a_pickle_that_runs_code_runs_nothing(tmp_path, protocol):
    mark = tmp_path / "was-run"
    data = pickle.dumps({"tracks": Runs(mark), "map_features": {}}, protocol)

    with pytest.raises(RecordError, match=r"imports|not a pickle of protocol 2"):
        unpickle(data)
    assert not mark.exists()


def code(*parts: bytes) -> bytes:
    return b"\x80\x04" + b"".join(parts) + b"."


def word(text: str) -> bytes:
    return b"\x8c" + bytes([len(text)]) + text.encode()


def imported(module: str, name: str) -> bytes:
    return word(module) + word(name) + b"\x93"


NDARRAY = imported("numpy", "ndarray")
DTYPE = imported("numpy", "dtype")
F8 = DTYPE + word("f8") + b"\x89\x88\x87R"
RECONSTRUCT = imported("numpy.core.multiarray", "_reconstruct")
EMPTY = RECONSTRUCT + NDARRAY + b"K\x00\x85C\x01b\x87R"
CRAFTED = {
    "system": code(imported("os", "system"), word("touch /tmp/x"), b"\x85R"),
    "protocol 2 global": b"\x80\x02cos\nsystem\nX\x01\x00\x00\x00x\x85R.",
    "builtins": code(imported("builtins", "eval"), word("1"), b"\x85R"),
    "getattr path": code(imported("numpy", "core.multiarray._reconstruct"), b"0N"),
    "numpy load": code(imported("numpy", "load"), word("/etc/passwd"), b"\x85R"),
    "ndarray called": code(NDARRAY, b"K\x01\x85R"),
    "function changed": code(DTYPE, b"}" + word("call") + b"Nsb"),
    "slots changed": code(DTYPE, b"N}" + word("__class__") + b"Ns\x86b"),
    "object built": code(NDARRAY, b")\x81"),
    "old object": code(b"(" + NDARRAY + b"o"),
    "persistent id": code(b"K\x01Q"),
    "extension": code(b"\x82\x01"),
    "odd type": code(DTYPE + word("V99999999") + b"\x89\x88\x87R"),
    "objects in list": code(b"K\x01", word("x"), b"a"),
    "nested key": code(b"}", b")" + b"\x85" * 50 + b"N", b"s"),
    "deep set": code(b"\x8f(", b"K\x01", b"\x85" * 50, b"\x90"),
    "huge memo": code(b"Nr" + struct.pack("<I", 2**32 - 1), b"j\x00\x00\x00\x00"),
    "bytes that are not there": code(b"\x96" + struct.pack("<Q", 2**40)),
    "text that is not there": code(b"\x8d" + struct.pack("<Q", 2**62)),
}


@pytest.mark.parametrize("name", CRAFTED)
def test_a_crafted_pickle_is_refused_and_runs_nothing(name, monkeypatch):
    monkeypatch.setattr(os, "system", lambda _: pytest.fail("was run"))

    with pytest.raises(RecordError):
        unpickle(CRAFTED[name])


def test_a_deeply_nested_value_is_no_key_and_does_not_end_the_process():
    """The tuple's hash would overflow the stack: in C nothing stops it."""
    with pytest.raises(RecordError):
        unpickle(code(b"})", b"\x85" * 500_000, b"Ns"))


STATES = {
    "shape too large": b"(K\x01K\x05\x85" + F8 + b"\x89C\x08" + bytes(8) + b"tb",
    "huge": b"(K\x01\x8a\x05\x00\x00\x00\x00\x7f\x85" + F8 + b"\x89C\x00tb",
    "negative": b"(K\x01J\xff\xff\xff\xff\x85" + F8 + b"\x89C\x00tb",
    "no type": b"(K\x01K\x01\x85N\x89C\x08" + bytes(8) + b"tb",
    "text for bytes": b"(K\x01K\x01\x85" + F8 + b"\x89" + word("12345678") + b"tb",
    "never filled": b"",
}


@pytest.mark.parametrize("name", STATES)
def test_an_array_whose_shape_and_bytes_differ_is_refused(name):
    found = unpickle(code(EMPTY, STATES[name]))

    with pytest.raises(RecordError):
        array(found)


def test_nothing_nested_reaches_numpy():
    """Lists that name one another make numpy count 10 ** 60 numbers."""
    value: list = [1.0] * 10
    for _ in range(60):
        value = [value] * 10

    with pytest.raises(RecordError, match="something else than numbers"):
        array(value)


def check_reason(error):
    assert str(error)


def outcome(data: bytes) -> None:
    modules = set(sys.modules)
    try:
        unpickle(data)
    except RecordError as error:
        check_reason(error)
    assert set(sys.modules) == modules


@given(at=st.integers(0, len(SOUND) - 1), byte=st.integers(0, 255))
def test_a_changed_byte_gives_a_value_or_a_reason(at, byte):
    outcome(SOUND[:at] + bytes([byte]) + SOUND[at + 1 :])


@given(cut=st.integers(0, len(SOUND) - 1))
def test_a_cut_pickle_is_refused(cut):
    with pytest.raises(RecordError):
        unpickle(SOUND[:cut])


@given(
    parts=st.lists(
        st.sampled_from(
            [*(bytes([op]) for op in range(256)), NDARRAY, DTYPE, F8, EMPTY, word("f8")]
        ),
        max_size=12,
    )
)
def test_any_opcodes_give_a_value_or_a_reason(parts):
    outcome(code(*parts))


def test_the_standard_unpickler_would_have_run_it(tmp_path):
    """What the tests above refuse is no empty threat."""
    mark = tmp_path / "was-run"
    pickle.Unpickler(io.BytesIO(pickle.dumps(Runs(mark), 4))).load().close()

    assert mark.exists()
