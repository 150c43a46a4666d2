import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.sources import batch, wire
from infgen.sources.batch import Messages, decode, messages
from infgen.sources.wire import BYTES, FIXED32, FIXED64, VARINT, tag
from tests.sources.scenario_proto import Scenario
from tests.sources.test_wire import field_bytes

STATE = {
    "center_x": tag(2, FIXED64),
    "length": tag(5, FIXED32),
    "valid": tag(11, VARINT),
}
State = type(Scenario().tracks.add().states.add())
LaneState = type(Scenario().dynamic_map_states.add().lane_states.add())


def laid_out(parts: list[bytes]) -> tuple[bytes, Messages]:
    """Messages end to end, one byte between them."""
    sizes = np.array([len(part) for part in parts], np.int64)
    starts = np.cumsum(sizes + 1) - sizes
    return b"".join(b"\xff" + part for part in parts), Messages(starts, sizes)


def check(parts: list[bytes]) -> None:
    """Compare states with protobuf's, bit for bit."""
    data, rows = laid_out(parts)
    table = decode(data, rows, STATE)
    expected = [State.FromString(part) for part in parts]
    for name in ("center_x", "length"):
        values = np.array([getattr(state, name) for state in expected], table[name].dtype)
        assert table[name].tobytes() == values.tobytes()
    assert (table["valid"] != 0).tolist() == [state.valid for state in expected]


def test_messages_of_one_layout_are_decoded_together():
    parts = [
        State(center_x=x, length=2.5, valid=True).SerializeToString() for x in range(50)
    ]

    data, rows = laid_out(parts)

    assert decode(data, rows, STATE)["center_x"].tolist() == list(range(50))


def test_layouts_may_alternate_and_fields_be_in_any_order():
    up = field_bytes(2, FIXED64, b"\1" * 8) + field_bytes(11, VARINT, 1)
    down = field_bytes(11, VARINT, 1) + field_bytes(2, FIXED64, b"\2" * 8)

    check([up, down, b"", up, b"\x58\x00", down, down])


def test_the_last_value_of_a_field_counts():
    check([field_bytes(11, VARINT, 1) + field_bytes(11, VARINT, 0)] * 3)


def test_unknown_fields_are_passed_over_whatever_they_hold():
    def part(inner):
        return field_bytes(90, BYTES, inner) + field_bytes(2, FIXED64, inner)

    check([part(b"\x11" * 8), part(b"\x58\x01" * 4), part(b"12345678")])


def test_a_known_number_of_another_wire_type_is_unknown():
    check([field_bytes(2, VARINT, 77) + field_bytes(11, FIXED32, b"1234")] * 2)


def test_equal_lengths_with_different_structure_are_told_apart():
    # The same tag, but a value of two bytes; and a group that ends earlier.
    wide, narrow = b"\x58\xac\x02" + b"\x58\x00", b"\x58\x01" + b"\x80\x06\x01"
    group, other = b"\x13\x08\x01\x14" + b"\x58\x01", b"\x13\x14" + b"\x58\x01" * 2

    check([wide, narrow, wide, narrow])
    check([group, other, group, other])


def test_more_layouts_than_the_batch_learns_are_read_one_by_one(monkeypatch):
    monkeypatch.setattr(batch, "_MAX_LAYOUTS", 2)
    parts = [
        State(center_x=1.5, valid=True).SerializeToString(),
        b"\x58\x01" + field_bytes(2, FIXED64, b"\2" * 8),
        field_bytes(5, FIXED32, b"abcd") + field_bytes(11, VARINT, 1) * 3,
        field_bytes(11, VARINT, 1) * 3 + field_bytes(5, FIXED32, b"abcd"),
    ]

    check(parts * 3)


def test_a_message_that_is_not_sound_is_refused():
    data, rows = laid_out([b"\x58\x01", b"\x11\x01"])

    with pytest.raises(wire.WireError, match="runs past"):
        decode(data, rows, STATE)


def test_sub_messages_come_as_position_and_size():
    columns = {"lane": tag(1, VARINT), "stop_point": tag(3, BYTES)}
    with_point, without = LaneState(lane=300, state=4), LaneState(lane=300, state=4)
    with_point.stop_point.x = 2.5
    data, rows = laid_out([m.SerializeToString() for m in (with_point, without)])

    table = decode(data, rows, columns)

    start, size = table["stop_point"][0], table["stop_point.size"][0]
    assert data[start : start + size] == with_point.stop_point.SerializeToString()
    assert table["stop_point"].tolist()[1] == -1
    assert table["lane"].tolist() == [300, 300]


def test_a_sub_message_given_twice_is_refused():
    data, rows = laid_out([field_bytes(3, BYTES, b"") * 2])

    with pytest.raises(wire.WireError, match="holds stop_point twice"):
        decode(data, rows, {"stop_point": tag(3, BYTES)})


def test_runs_are_spelled_out_in_order():
    spans = wire.Spans()
    spans.add(10, 5, 3)
    spans.add(100, 200)
    spans.add(400, 0, 2)

    rows = messages(spans)

    assert rows.start.tolist() == [10, 17, 24, 100, 400, 402]
    assert rows.size.tolist() == [5, 5, 5, 200, 0, 0]


def test_no_messages_are_no_rows():
    rows = messages(wire.Spans())

    assert len(rows) == 0
    assert decode(b"", rows, STATE)["center_x"].shape == (0,)


DOUBLES = st.floats(width=64).map(lambda x: np.float64(x).tobytes())
FLOATS = st.floats(width=32, allow_nan=False).map(lambda x: np.float32(x).tobytes())
STATE_FIELD = st.one_of(
    st.tuples(st.just(2), st.just(FIXED64), DOUBLES),
    st.tuples(st.just(5), st.just(FIXED32), FLOATS),
    st.tuples(st.just(11), st.just(VARINT), st.integers(0, 2**64 - 1)),
    st.tuples(st.integers(1, 3000), st.just(VARINT), st.integers(0, 300)),
    st.tuples(st.integers(20, 30), st.just(BYTES), st.binary(max_size=12)),
)


@given(parts=st.lists(st.lists(STATE_FIELD, max_size=6), min_size=1, max_size=8))
def test_any_messages_decode_as_protobuf_decodes_them(parts):
    check([b"".join(field_bytes(*field) for field in part) for part in parts] * 2)
