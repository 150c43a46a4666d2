import shutil

import pytest

from pipeline.engine.atomic import StoreError
from pipeline.engine.manifest import crc32c, list_files, read_manifest, verify


@pytest.fixture
def made(workshop):
    """A made root, the folder of a stage and that of one of its units."""
    workshop.run()
    stage = workshop.root.latest_folder("count")
    unit = read_manifest(stage)["units"][0]["key"]
    return workshop.root, stage, workshop.root.unit("count", unit)


def damage(root, *, full=False):
    return list(verify(root, full=full))


def way_out(root, stage="count"):
    return f"; `infgen run {stage} --root {root.path} --force` makes it again"


def test_a_file_is_listed_with_its_bytes_and_checksum(tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "file").write_bytes(b"123456789")

    # The check value of CRC-32C.
    assert list_files(tmp_path) == {"deep/file": [9, "e3069283"]}


def test_a_checksum_of_many_blocks_is_that_of_the_whole(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_bytes(b"123456789" * 100)
    whole = crc32c(path)
    monkeypatch.setattr("pipeline.engine.manifest.BLOCK_BYTES", 7)

    assert crc32c(path) == whole


def test_a_whole_root_has_no_damage(made):
    assert damage(made[0], full=True) == []


def test_a_missing_file_is_named(made):
    root, _, unit = made
    (unit / "count.json").unlink()

    assert damage(root) == [f"{unit / 'count.json'} is missing{way_out(root)}"]


def test_a_file_of_another_size_is_named(made):
    root, stage, _ = made
    (stage / "words.json").write_text("{}")

    (line,) = damage(root)
    assert line.startswith(f"{stage / 'words.json'} holds 2 bytes, expected ")


def test_a_flipped_bit_is_found_by_checksums_only(made):
    root, _, unit = made
    data = bytearray((unit / "count.json").read_bytes())
    data[3] ^= 1
    (unit / "count.json").write_bytes(data)

    assert damage(root) == []
    (line,) = damage(root, full=True)
    assert "count.json has checksum" in line


def test_a_file_too_many_is_named(made):
    root, _, unit = made
    (unit / "stray").write_text("?")

    assert damage(root) == [f"{unit / 'stray'} is not in the manifest{way_out(root)}"]


def test_a_unit_that_is_gone_is_named(made):
    root, _, unit = made
    shutil.rmtree(unit)

    assert damage(root) == [f"{unit} is missing (unit a.txt){way_out(root)}"]


@pytest.mark.parametrize("text", ["", "{", "[]", "{}"])
def test_a_damaged_manifest_is_named(made, text):
    root, stage, _ = made
    (stage / "manifest.json").write_text(text)

    (line,) = damage(root)
    assert line.startswith(f"{stage / 'manifest.json'} is damaged")
    assert line.endswith(way_out(root))
    with pytest.raises(StoreError, match=r"is damaged.*`infgen run count --root"):
        read_manifest(stage)


def test_a_damaged_folder_that_no_root_holds_has_no_stage_to_run(tmp_path):
    (tmp_path / "manifest.json").write_text("{}")

    with pytest.raises(StoreError, match=r"lists no files$"):
        read_manifest(tmp_path)


def test_what_is_not_finished_is_no_damage(made):
    root, stage, _ = made
    (stage.with_name("0123456789abcdef.partial")).mkdir()

    assert damage(root) == []
