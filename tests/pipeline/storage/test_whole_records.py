"""Records come back as they went, each by one read."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float32, Int8, Int64

from pipeline.engine.atomic import StoreError
from pipeline.storage.whole_records import (
    WholeRecords,
    read_whole_records,
    write_whole_records,
)
from pipeline.storage.zarr_store import open_group, read_group, write_group

SCHEMA = "things/1"


@dataclass(frozen=True)
class Shape:
    point: Float32[np.ndarray, "point 2"]
    length: Int8[np.ndarray, " point+1"]


@dataclass(frozen=True)
class Thing:
    name: str
    shape: Shape
    weight: float
    number: Int64[np.ndarray, "row point"]


def thing(name, points, rows):
    random = np.random.default_rng([points, rows, len(name)])
    return Thing(
        name,
        Shape(
            random.normal(size=(points, 2)).astype(np.float32),
            random.integers(-9, 9, points + 1).astype(np.int8),
        ),
        float(random.normal()),
        random.integers(-(1 << 40), 1 << 40, (rows, points)),
    )


def assert_same(one, other):
    assert (one.name, one.weight) == (other.name, other.weight)
    np.testing.assert_array_equal(one.shape.point, other.shape.point)
    np.testing.assert_array_equal(one.shape.length, other.shape.length)
    np.testing.assert_array_equal(one.number, other.number)


THINGS = st.lists(
    st.builds(thing, st.text(max_size=9), st.integers(0, 4), st.integers(0, 3)), max_size=5
)


@given(THINGS)
def test_records_come_back_in_any_order(tmp_path_factory, things):
    path = tmp_path_factory.mktemp("things") / "things.zarr"
    write_whole_records(path, things, Thing, SCHEMA)

    found = read_whole_records(path, Thing, SCHEMA)

    assert len(found) == len(things)
    for row in reversed(range(len(things))):
        assert_same(found[row], things[row])
    assert found.sizes("point").tolist() == [len(each.shape.point) for each in things]


class Counted:
    """A column that counts how often it is read."""

    def __init__(self, column):
        self.column, self.reads = column, 0

    def __len__(self):
        return len(self.column)

    def __getitem__(self, part):
        self.reads += 1
        return self.column[part]


def test_a_record_is_one_read(tmp_path):
    path = tmp_path / "things.zarr"
    write_whole_records(path, [thing("a", 3, 2), thing("b", 1, 1)], Thing, SCHEMA)
    columns, about = open_group(path)
    data = Counted(columns["bytes"])
    sizes = columns["sizes"][:].reshape(2, len(about["dims"]))

    assert_same(WholeRecords(data, sizes, Thing)[1], thing("b", 1, 1))

    assert data.reads == 1


def test_another_schema_or_a_group_cut_short_is_refused(tmp_path):
    path = tmp_path / "things.zarr"
    write_whole_records(path, [thing("a", 3, 2)], Thing, SCHEMA)
    with pytest.raises(StoreError, match="expected 'things/2'; run its stage again"):
        read_whole_records(path, Thing, "things/2")

    columns, about = read_group(path)
    short, bare = tmp_path / "short.zarr", tmp_path / "bare.zarr"
    write_group(short, {**columns, "bytes": columns["bytes"][:-8]}, about, compress=False)
    with pytest.raises(StoreError, match="bytes of records, expected"):
        read_whole_records(short, Thing, SCHEMA)
    write_group(bare, {"bytes": columns["bytes"]}, about, compress=False)
    with pytest.raises(StoreError, match="lacks sizes"):
        read_whole_records(bare, Thing, SCHEMA)


def test_what_is_no_row_is_refused(tmp_path):
    path = tmp_path / "things.zarr"
    write_whole_records(path, [thing("a", 3, 2)], Thing, SCHEMA)
    found = read_whole_records(path, Thing, SCHEMA)

    assert_same(found[-1], thing("a", 3, 2))
    assert [each.name for each in found[:]] == ["a"]
    with pytest.raises(IndexError, match="record 1 of 1"):
        found[1]
    assert replace(found[0], weight=1.0).weight == 1.0
