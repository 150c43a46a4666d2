import pytest
from google.protobuf import unknown_fields
from hypothesis import given
from hypothesis import strategies as st

from infgen.sources import wire
from infgen.sources.wire import BYTES, FIXED32, FIXED64, GROUP, GROUP_END, VARINT, tag
from tests.sources.scenario_proto import Scenario

ANY = type(Scenario().tracks.add())  # has few fields: all the others are unknown to it


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def field_bytes(number: int, wire_type: int, value: object) -> bytes:
    key = varint(tag(number, wire_type))
    if wire_type == VARINT:
        return key + varint(value)
    if wire_type == BYTES:
        return key + varint(len(value)) + value
    if wire_type == GROUP:
        return key + value + varint(tag(number, GROUP_END))
    return key + value


FIELDS = st.one_of(
    st.tuples(st.integers(20, 3000), st.just(VARINT), st.integers(0, 2**64 - 1)),
    st.tuples(st.integers(20, 3000), st.just(FIXED64), st.binary(min_size=8, max_size=8)),
    st.tuples(st.integers(20, 3000), st.just(FIXED32), st.binary(min_size=4, max_size=4)),
    st.tuples(st.integers(20, 3000), st.just(BYTES), st.binary(max_size=300)),
    st.tuples(st.integers(20, 3000), st.just(GROUP), st.just(b"\x08\x01\x13\x08\x02\x14")),
)


def walk(data):
    return wire.walk(data, 0, len(data))


@given(fields=st.lists(FIELDS, max_size=12))
def test_walk_finds_the_fields_that_were_written(fields):
    data = b"".join(field_bytes(*field) for field in fields)

    found = walk(data)

    assert [field.tag for field in found] == [tag(n, w) for n, w, _ in fields]
    for field, (_, wire_type, value) in zip(found, fields, strict=True):
        if wire_type == VARINT:
            assert field.value == value
        elif wire_type != GROUP:
            assert data[field.start : field.end] == value


@given(fields=st.lists(FIELDS, max_size=6), cut=st.integers(0, 300), junk=st.binary())
def test_walk_agrees_with_protobuf_on_what_is_a_message(fields, cut, junk):
    data = b"".join(field_bytes(*field) for field in fields)
    data = data[: max(0, len(data) - cut)] + junk[: cut % 7]

    try:
        ours = len(walk(data))
    except wire.WireError:
        ours = None
    message = ANY()
    try:
        message.ParseFromString(data)
        theirs = len(unknown_fields.UnknownFieldSet(message))
    except Exception:
        theirs = None

    assert (ours is None) == (theirs is None)
    known = ours is None or any(field.tag >> 3 <= 3 for field in walk(data))
    assert known or ours == theirs


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"\x80", "runs past"),
        (b"\x80" * 11, "does not end"),
        (b"\x00\x01", "number 0"),
        (b"\x0e\x01", "wire type 6"),
        (b"\x0c", "runs past"),
        (b"\x09\x01\x02", "runs past"),
        (b"\x0a\x05ab", "runs past"),
        (b"\x0a", "runs past"),
        (b"\x08", "runs past"),
        (b"\x0b\x08\x01\x14", "does not match"),
        (b"\x0b" * 200, "too deep"),
    ],
)
def test_what_is_no_message_is_refused(data, words):
    with pytest.raises(wire.WireError, match=words):
        walk(data)


def test_a_varint_of_ten_bytes_keeps_64_bits():
    assert wire.read_varint(b"\xff" * 9 + b"\x01", 0, 10) == (2**64 - 1, 10)


@pytest.mark.parametrize(
    ("value", "bits", "expected"),
    [(5, 32, 5), (2**64 - 1, 32, -1), (2**32 - 2, 32, -2), (2**63, 64, -(2**63))],
)
def test_signed_reads_the_low_bits_as_protobuf_does(value, bits, expected):
    assert wire.signed(value, bits) == expected


@given(sizes=st.lists(st.sampled_from([0, 2, 2, 2, 59, 59, 126, 130]), max_size=40))
def test_split_notes_every_repeated_message_and_returns_the_others(sizes):
    parts = [field_bytes(3, BYTES, b"\x1a" * size) for size in sizes]
    data = b"\x08\x05" + b"".join(parts[:20]) + b"\x10\x01" + b"".join(parts[20:])
    spans = wire.Spans()

    others = wire.split(data, 0, len(data), tag(3, BYTES), spans)

    assert [(field.tag, field.value) for field in others] == [(8, 5), (16, 1)]
    assert spans.total == len(sizes)
    found = [size for _, size, count in spans.runs().tolist() for _ in range(count)]
    assert found == sizes


def test_split_never_looks_beyond_its_message():
    data = b"\x1a\x01A" * 3
    spans = wire.Spans()

    wire.split(data, 0, 6, tag(3, BYTES), spans)

    assert spans.runs().tolist() == [[2, 1, 2]]
    with pytest.raises(wire.WireError, match="runs past"):
        wire.split(data, 0, 8, tag(3, BYTES), wire.Spans())


def test_packed_and_single_values_are_read_alike():
    packed = field_bytes(9, BYTES, varint(5) + varint(2**64 - 1))
    single = field_bytes(9, VARINT, 5) + field_bytes(9, VARINT, 2**64 - 1)

    assert wire.varints(packed, walk(packed), 9) == [5, -1]
    assert wire.varints(single, walk(single), 9) == [5, -1]


def test_packed_doubles_must_be_whole():
    data = field_bytes(1, BYTES, bytes(12))

    with pytest.raises(wire.WireError, match="whole number of doubles"):
        wire.doubles(data, walk(data), 1)


def test_the_last_of_a_repeated_single_value_counts():
    data = b"\x08\x05\x08\x06"

    assert wire.last(walk(data), 8) == 6
    assert wire.last(walk(data), 16, default=3) == 3


def test_unknown_enum_values_do_not_count():
    data = b"\x08\x05\x08\x63"

    assert wire.last_enum(walk(data), 8, largest=8) == 5
    assert wire.last_enum(walk(b"\x08\x63"), 8, largest=8) == 0


def test_more_messages_than_any_record_holds_are_refused():
    with pytest.raises(wire.WireError, match="more than 16000000 points or states"):
        wire.Spans().add(2, 0, wire.MAX_MESSAGES + 1)


def test_more_fields_than_any_message_holds_are_refused(monkeypatch):
    monkeypatch.setattr(wire, "MAX_FIELDS", 10)
    walk(b"\x08\x01" * 10)

    with pytest.raises(wire.WireError, match="holds more than 10 fields"):
        walk(b"\x08\x01" * 11)
    packed = field_bytes(9, BYTES, b"\x01" * 11)
    with pytest.raises(wire.WireError, match="field 9 has more than 10 values"):
        wire.varints(packed, walk(packed), 9)
