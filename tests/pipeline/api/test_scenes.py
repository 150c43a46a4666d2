"""Scenes as a sequence: what is not asked for is not read."""

import subprocess
import sys

import pytest

import infgen
from infgen.errors import ConfigError
from infgen.sources.towns import builtin_records
from infgen.sources.womd import iter_scenes

VALIDATION = builtin_records()[-1]


@pytest.fixture(scope="module")
def ids():
    return [scene.scenario_id for scene in iter_scenes(VALIDATION)]


COUNTED = """
import infgen
from pipeline.storage.sources import raw_scenes

decoded, decode = [], raw_scenes.decode_scene
raw_scenes.decode_scene = lambda data: decoded.append(0) or decode(data)
scenes = infgen.open_scenes("builtin", split="validation")
part = scenes[2:5]
print(len(decoded))
part[1]
print(len(decoded))
for _ in zip(range(2), scenes): pass
print(len(decoded))
assert len(scenes) == 8
print(len(decoded))
"""


def test_scenes_are_a_sequence_in_the_order_of_the_records(ids):
    scenes = infgen.open_scenes(VALIDATION)

    assert scenes[1].scenario_id == ids[1]
    assert scenes[-1].scenario_id == ids[-1]
    assert [scene.scenario_id for scene in scenes[1:3]] == ids[1:3]
    assert [scene.scenario_id for scene in scenes[::-3]] == ids[::-3]
    assert list(scenes[2:].scenario_ids) == ids[2:]
    assert len(scenes) == len(ids)
    assert [scene.scenario_id for scene in scenes] == ids
    assert ids[3] in scenes
    assert "nowhere" not in scenes


def test_a_scene_is_found_by_the_start_of_its_id(ids):
    scenes = infgen.open_scenes(VALIDATION)

    assert scenes[ids[4]].scenario_id == ids[4]
    assert scenes[ids[4][:6]].scenario_id == ids[4]
    assert scenes[2:][ids[4][:6]].scenario_id == ids[4]
    with pytest.raises(ConfigError, match=f"starts with 'zz'; there is {ids[0]}"):
        scenes["zz"]
    with pytest.raises(ConfigError, match=f"no scene .* starts with '{ids[5]}'"):
        scenes[:4][ids[5]]


def test_only_what_is_asked_for_is_decoded():
    # In a process of its own: here the checks of annotations look into sequences.
    done = subprocess.run(
        [sys.executable, "-c", COUNTED], capture_output=True, text=True, check=True
    )

    assert [int(line) for line in done.stdout.split()] == [0, 1, 3, 3]


def test_a_split_is_chosen_by_file_names(ids):
    assert len(infgen.open_scenes("builtin")) == 32
    assert list(infgen.open_scenes("builtin", split="validation").scenario_ids) == ids
    with pytest.raises(ConfigError, match="no split 'test'; there is training, validation"):
        infgen.open_scenes("builtin", split="test")


def test_what_is_not_there_is_told():
    with pytest.raises(ConfigError, match="no records match"):
        infgen.open_scenes("nowhere/*.tfrecord")
    with pytest.raises(IndexError, match=r"no scene 8; .* holds 8 scenes"):
        infgen.open_scenes(VALIDATION)[8]


def test_records_that_cannot_be_used_are_told(tmp_path):
    path = tmp_path / "broken.tfrecord"
    path.write_bytes(b"no record at all, whatever its name")

    assert len(infgen.open_scenes(path)) == 0
    with pytest.raises(ConfigError, match=r"no usable record: .*broken"):
        infgen.open_scenes(path)[0]
