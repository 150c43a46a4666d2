"""Roots: what is taken for one, and what is refused."""

import pytest

from infgen.errors import ConfigError
from pipeline.engine.atomic import write_json
from pipeline.engine.layout import MANIFEST, STAGE_SCHEMA, Root, find_root


def made_with(path, schema) -> Root:
    root = Root(path)
    folder = root.folder("ingest", "0" * 64)
    folder.mkdir(parents=True)
    write_json(folder / MANIFEST, {"schema": schema, "files": {}})
    return root


def test_a_root_of_an_earlier_version_is_refused_with_the_way_out(tmp_path):
    root = made_with(tmp_path / "old", "infgen.stage/1")

    with pytest.raises(
        ConfigError, match=r"earlier version.*`infgen run --root .*old` makes"
    ):
        find_root(root.path)


def test_a_root_of_this_version_is_taken(tmp_path):
    root = made_with(tmp_path / "new", STAGE_SCHEMA)

    assert find_root(root.path, made=True) == root


def test_a_damaged_manifest_is_left_to_the_command(tmp_path):
    root = made_with(tmp_path / "bad", STAGE_SCHEMA)
    (root.folder("ingest", "0" * 64) / MANIFEST).write_text("{")

    assert find_root(root.path) == root


def test_a_file_and_an_empty_root_are_refused(tmp_path):
    (tmp_path / "file").touch()

    with pytest.raises(ConfigError, match="is a file; expected a folder"):
        find_root(tmp_path / "file" / "root")
    with pytest.raises(ConfigError, match="no such root"):
        find_root(tmp_path / "none", made=True)
