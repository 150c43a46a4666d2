import gzip
import struct
import tracemalloc
import zlib

import fsspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.sources.tfrecord import (
    BadRecord,
    Record,
    frame,
    iter_records,
    masked_crc,
)

RECORDS = [b"first", b"", b"third record", bytes(range(256)) * 500]


def write(tmp_path, data, name="a.tfrecord"):
    path = tmp_path / name
    path.write_bytes(data)
    return path


def framed(records=RECORDS):
    return b"".join(frame(record) for record in records)


def read(path, **limits):
    return list(iter_records(path, **limits))


def reasons(found):
    return [record.reason for record in found if isinstance(record, BadRecord)]


def usable(found):
    return [record.data for record in found if isinstance(record, Record)]


def flipped(data, at):
    return data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :]


@pytest.mark.parametrize("pack", [bytes, gzip.compress], ids=["plain", "gzip"])
def test_records_come_back_with_number_and_offset(tmp_path, pack):
    found = read(write(tmp_path, pack(framed())))

    assert usable(found) == RECORDS
    assert [record.number for record in found] == [0, 1, 2, 3]
    assert [record.offset for record in found] == [0, 21, 37, 65]


def test_checksum_is_the_one_of_the_tfrecord_format():
    # The example of TensorFlow's documentation: crc32c of 9 digits is 0xe3069283.
    crc = 0xE3069283
    assert masked_crc(b"123456789") == ((crc >> 15 | crc << 17) + 0xA282EAD8) % 2**32


def test_a_record_with_damaged_data_is_one_bad_record_and_reading_goes_on(tmp_path):
    data = framed()
    found = read(write(tmp_path, flipped(data, 37 + 12)))

    assert usable(found) == [RECORDS[0], RECORDS[1], RECORDS[3]]
    assert found[2] == BadRecord(2, 37, "data checksum does not match")


def test_a_damaged_data_checksum_is_told_like_damaged_data(tmp_path):
    found = read(write(tmp_path, flipped(framed(), 18)))

    assert found[0] == BadRecord(0, 0, "data checksum does not match")
    assert usable(found) == RECORDS[1:]


@pytest.mark.parametrize("at", [37, 37 + 9], ids=["length", "its checksum"])
def test_a_damaged_length_ends_the_file_with_one_bad_record(tmp_path, at):
    found = read(write(tmp_path, flipped(framed(), at)))

    assert usable(found) == RECORDS[:2]
    assert found[2] == BadRecord(2, 37, "length checksum does not match")
    assert len(found) == 3


def test_a_file_cut_inside_a_record_says_where(tmp_path):
    found = read(write(tmp_path, framed()[: 37 + 20]))

    assert usable(found) == RECORDS[:2]
    assert found[2] == BadRecord(2, 37, "file ends inside the record: 20 of 28 bytes")


def test_a_file_cut_inside_a_header_says_where(tmp_path):
    found = read(write(tmp_path, framed()[: 37 + 5]))

    assert found[2] == BadRecord(2, 37, "file ends inside a record's header: 5 of 12 bytes")


def test_a_length_beyond_the_limit_is_skipped_without_being_held(tmp_path):
    found = read(write(tmp_path, framed()), max_bytes=100)

    assert usable(found) == RECORDS[:3]
    assert reasons(found) == ["record of 128000 bytes is longer than the limit of 100"]


def test_records_after_one_that_is_too_long_are_read(tmp_path):
    found = read(write(tmp_path, framed([b"x" * 200, b"ok"])), max_bytes=100)

    assert usable(found) == [b"ok"]
    assert [record.offset for record in found] == [0, 216]


def test_a_huge_length_never_allocates(tmp_path):
    length = struct.pack("<Q", 1 << 62)
    header = length + struct.pack("<I", masked_crc(length))
    path = write(tmp_path, framed([b"good"]) + header + b"rest")

    tracemalloc.start()
    found = read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert usable(found) == [b"good"]
    assert "longer than the limit" in reasons(found)[0]
    assert peak < 2**20


def test_a_gzip_bomb_is_unpacked_in_bounded_memory(tmp_path):
    packer = zlib.compressobj(wbits=31)
    length = struct.pack("<Q", 1 << 28)
    bomb = packer.compress(length + struct.pack("<I", masked_crc(length)))
    bomb += b"".join(packer.compress(bytes(1 << 20)) for _ in range(256)) + packer.flush()
    path = write(tmp_path, bomb)

    tracemalloc.start()
    found = read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert "longer than the limit" in reasons(found)[0]
    assert peak < 8 * 2**20


def test_an_empty_file_is_a_bad_record(tmp_path):
    assert read(write(tmp_path, b"")) == [BadRecord(0, 0, "file is empty")]
    assert read(write(tmp_path, gzip.compress(b""))) == [BadRecord(0, 0, "file is empty")]


def test_a_gzip_stream_that_ends_early_gives_the_records_before(tmp_path):
    packed = gzip.compress(framed([b"a" * 100] * 50), 0)
    found = read(write(tmp_path, packed[: len(packed) // 2]))

    assert 20 < len(usable(found)) < 30
    assert reasons(found) == ["gzip stream ends early"]


def test_a_gzip_stream_without_its_trailer_is_told(tmp_path):
    found = read(write(tmp_path, gzip.compress(framed())[:-3]))

    assert usable(found) == RECORDS
    assert reasons(found) == ["gzip stream ends early"]


def test_a_wrong_gzip_checksum_costs_no_record(tmp_path):
    packed = gzip.compress(framed())
    found = read(write(tmp_path, flipped(packed, len(packed) - 6)))

    assert usable(found) == RECORDS
    assert reasons(found) == [
        "gzip stream is damaged: Error -3 while decompressing data: incorrect data check"
    ]
    assert found[-1].number == len(RECORDS)


def test_damaged_values_inside_a_gzip_stream_cost_only_their_record(tmp_path):
    packed = gzip.compress(framed([b"a" * 1000] * 200), 0)  # stored, not packed
    found = read(write(tmp_path, flipped(packed, len(packed) // 2)))

    assert len(usable(found)) == 199
    assert reasons(found) == [
        "data checksum does not match",
        "gzip stream is damaged: Error -3 while decompressing data: incorrect data check",
    ]


def test_damaged_structure_of_a_gzip_stream_keeps_what_came_before(tmp_path):
    records = [bytes([i, j]) * 200 for i in range(200) for j in range(20)]
    packed = gzip.compress(framed(records))
    half = len(packed) // 2
    found = read(write(tmp_path, packed[:half] + b"\xff" * 100 + packed[half + 100 :]))

    assert usable(found) == records[: len(usable(found))]
    assert len(usable(found)) > 1000
    assert reasons(found)


def test_gzip_members_may_follow_each_other_and_be_padded(tmp_path):
    first, second = gzip.compress(framed(RECORDS[:2])), gzip.compress(framed(RECORDS[2:]))
    found = read(write(tmp_path, first + second + bytes(100_000)))

    assert usable(found) == RECORDS
    assert reasons(found) == []


def test_bytes_after_a_gzip_stream_are_told(tmp_path):
    found = read(write(tmp_path, gzip.compress(framed()) + b"junk"))

    assert usable(found) == RECORDS
    assert reasons(found) == ["bytes after the end of the gzip stream are not gzip"]


def test_a_plain_file_that_looks_like_gzip_is_read_as_plain(tmp_path):
    record = b"x" * 0x88B1F  # its length is written 1f 8b 08 00 ...: the magic of GZIP
    path = write(tmp_path, frame(record))

    assert path.read_bytes().startswith(b"\x1f\x8b\x08")
    assert usable(read(path)) == [record]


@pytest.mark.parametrize(
    ("head", "words"),
    [
        (b"PK\x03\x04", "zip archive"),
        (b"BZh9", "bzip2"),
        (b"\xfd7zXZ\0", "xz"),
        (b"\x28\xb5\x2f\xfd", "zstd"),
        (b"\x89HDF\r\n", "HDF5"),
        (b"PAR1", "Parquet"),
        (b"<!DOCTYPE html>", "web page"),
        (b'{"a": 1}', "JSON"),
        (b"version https://git-lfs.github.com/spec/v1", "Git LFS pointer"),
    ],
)
def test_other_formats_are_named(tmp_path, head, words):
    found = read(write(tmp_path, head + bytes(64)))

    assert len(found) == 1
    assert words in found[0].reason


def test_other_formats_inside_gzip_are_named(tmp_path):
    found = read(write(tmp_path, gzip.compress(b"<html>" + bytes(64))))

    assert "web page" in found[0].reason


def test_records_are_read_from_fsspec_urls():
    with fsspec.open("memory://there/a.tfrecord.gz", "wb") as file:
        file.write(gzip.compress(framed()))

    assert usable(read("memory://there/a.tfrecord.gz")) == RECORDS


def test_a_missing_file_is_raised_and_not_called_a_bad_record(tmp_path):
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "none.tfrecord")


@given(records=st.lists(st.binary(max_size=300), min_size=1, max_size=8))
def test_framing_has_an_inverse(tmp_path_factory, records):
    path = write(tmp_path_factory.mktemp("files"), framed(records))

    assert usable(read(path)) == records


@given(data=st.data(), gzipped=st.booleans())
def test_any_flip_or_cut_is_named_and_harms_only_what_it_hits(
    tmp_path_factory, data, gzipped
):
    records = [b"one" * 20, b"two" * 30, b"three"]
    whole = gzip.compress(framed(records), 1) if gzipped else framed(records)
    at = data.draw(st.integers(0, len(whole) - 1))
    bits = data.draw(st.integers(1, 255))
    broken = whole[:at] + bytes([whole[at] ^ bits]) + whole[at + 1 :]
    if data.draw(st.booleans()):
        broken = broken[: data.draw(st.integers(0, len(broken)))]

    found = read(write(tmp_path_factory.mktemp("files"), broken))

    assert set(usable(found)) <= set(records)
    # A GZIP header has bytes that mean nothing (time, system): a flip there is no harm.
    # And what is cut between two records is a whole file, of fewer records.
    fewer = [framed(records[:count]) for count in range(3)]
    assert reasons(found) or len(usable(found)) == 3 or broken in fewer
    assert [record.number for record in found] == list(range(len(found)))


@given(junk=st.binary(max_size=2000))
def test_random_bytes_never_crash_and_are_named(tmp_path_factory, junk):
    for data in (junk, b"\x1f\x8b\x08" + junk, gzip.compress(junk)):
        found = read(write(tmp_path_factory.mktemp("files"), data))
        assert reasons(found)
