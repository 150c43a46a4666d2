from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Bool, Float32, Int16, Int64

from infgen.scene import Scene
from infgen.tokens.scene_tokens import SceneTokens
from pipeline.storage.columns import PackedRecords, leaves, names, pack


@dataclass(frozen=True, slots=True)
class Wheel:
    spoke_m: Float32[np.ndarray, "spoke 3"]
    true: Bool[np.ndarray, " spoke"]


@dataclass(frozen=True, slots=True)
class Cart:
    name: str
    age: int
    load_kg: float
    origin_m: Float32[np.ndarray, "2"]
    wheel: Wheel
    path_m: Float32[np.ndarray, "cart step 2"]
    offsets: Int64[np.ndarray, " box+1"]
    box: Int16[np.ndarray, " box"]


@dataclass(frozen=True, slots=True)
class Coin:
    value: int
    weight_g: float


def make_cart(name="cart", spokes=2, carts=1, steps=3, boxes=2, seed=0):
    rng = np.random.default_rng(seed)
    return Cart(
        name=name,
        age=int(rng.integers(-5, 100)),
        load_kg=float(rng.normal()),
        origin_m=rng.normal(size=2).astype(np.float32),
        wheel=Wheel(
            rng.normal(size=(spokes, 3)).astype(np.float32), rng.random(spokes) < 0.5
        ),
        path_m=rng.normal(size=(carts, steps, 2)).astype(np.float32),
        offsets=np.arange(boxes + 1),
        box=rng.integers(0, 99, boxes).astype(np.int16),
    )


def assert_equal_records(one, other):
    for leaf in leaves(type(one)):
        first, second = one, other
        for part in leaf.path:
            first, second = getattr(first, part), getattr(second, part)
        assert type(first) is type(second), leaf.name
        np.testing.assert_array_equal(first, second, strict=leaf.dims is not None)


sizes = st.integers(0, 4)
carts = st.builds(make_cart, st.text(), sizes, sizes, sizes, sizes, st.integers(0, 9))


@given(st.lists(carts, max_size=5))
def test_unpacking_gives_back_what_was_packed(records):
    unpacked = PackedRecords(pack(records, Cart), Cart)

    assert len(unpacked) == len(records)
    for one, other in zip(records, unpacked, strict=True):
        assert_equal_records(one, other)


@given(st.lists(carts, min_size=1, max_size=5))
def test_columns_are_flat_and_named_by_their_fields(records):
    columns = pack(records, Cart)

    assert columns.keys() == names(Cart)
    assert all(column.ndim == 1 for column in columns.values())
    assert columns["wheel.spoke_m"].dtype == np.float32


def test_sizes_of_a_dimension_are_kept_once_per_record():
    columns = pack([make_cart(boxes=2), make_cart(boxes=5)], Cart)

    assert columns["dim.box"].tolist() == [2, 5]
    assert columns["offsets"].tolist() == [0, 1, 2, 0, 1, 2, 3, 4, 5]
    assert PackedRecords(columns, Cart).sizes("box").tolist() == [2, 5]


def test_records_without_any_dimension_are_counted():
    coins = [Coin(1, 2.5), Coin(2, 3.5)]

    assert list(PackedRecords(pack(coins, Coin), Coin)) == coins


def test_rows_count_from_the_end_and_slice_as_in_a_list():
    records = [make_cart(name) for name in "abcd"]
    unpacked = PackedRecords(pack(records, Cart), Cart)

    assert unpacked[-1].name == "d"
    assert [record.name for record in unpacked[1:3]] == ["b", "c"]
    with pytest.raises(IndexError, match="record 4 of 4"):
        unpacked[4]


def test_arrays_are_views_of_the_columns():
    unpacked = PackedRecords(pack([make_cart(), make_cart()], Cart), Cart)

    assert np.shares_memory(unpacked[1].path_m, unpacked.column("path_m"))


def test_a_dimension_with_two_sizes_in_one_record_is_refused():
    @dataclass(frozen=True)
    class Pair:
        left: Int16[np.ndarray, " item"]
        right: Int16[np.ndarray, " item"]

    uneven = Pair(np.zeros(2, np.int16), np.zeros(3, np.int16))

    with pytest.raises(ValueError, match="'item' has two sizes"):
        pack([uneven], Pair)


def test_a_field_that_is_no_column_is_refused_by_name():
    @dataclass(frozen=True)
    class Bag:
        things: list

    with pytest.raises(TypeError, match=r"Bag\.things"):
        leaves(Bag)


@pytest.mark.parametrize("kind", [Scene, SceneTokens])
def test_the_records_of_the_project_fit(kind):
    empty = pack([], kind)

    assert empty.keys() == names(kind)
    assert len(PackedRecords(empty, kind)) == 0


def test_a_scene_comes_back(crossing):
    scene = crossing()

    assert_equal_records(scene, PackedRecords(pack([scene, scene], Scene), Scene)[1])
