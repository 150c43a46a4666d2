"""Against the real records that lie beside the checkout."""

import json
import subprocess
import sys
from itertools import islice

import numpy as np
import pytest

from infgen.scene import world_xyz_m
from infgen.sources.tfrecord import iter_records
from infgen.sources.womd import decode_scene, iter_scenes
from tests.sources.oracle import expected_scene
from tests.sources.records import SHARED
from tests.sources.scenario_proto import Scenario
from tests.sources.test_womd import differences

pytestmark = pytest.mark.skipif(
    not SHARED.is_dir(), reason="needs the shared WOMD records (../shared/data/womd)"
)
FILES = sorted(SHARED.glob("*.gz"))


LIST_IDS = """
import sys
from infgen.sources.womd import iter_scenes
for path in sys.argv[1:]:
    for scene in iter_scenes(path):
        print(scene.scenario_id)
"""
"""A program of its own: here, the shape checks would take most of the time."""


def compare(data: bytes) -> None:
    scene, message = decode_scene(data), Scenario.FromString(data)
    assert differences(scene, expected_scene(message)) == []
    world_m = np.array(
        [[(s.center_x, s.center_y, s.center_z) for s in t.states] for t in message.tracks]
    )
    found_m = world_xyz_m(scene, scene.tracks.xyz_m).astype(np.float64)
    local_ulp_m = np.spacing(np.abs(scene.tracks.xyz_m))
    world_ulp_m = np.spacing(np.abs(world_m).astype(np.float32))
    assert (np.abs(found_m - world_m) <= (local_ulp_m + world_ulp_m) / 2).all()
    zero = world_m == 0
    np.testing.assert_array_equal(found_m[zero], 0.0)


def test_the_first_record_of_each_file_is_read_as_protobuf_reads_it():
    for path in FILES[::3]:
        compare(next(iter_records(path)).data)


@pytest.mark.slow
def test_a_tenth_of_all_records_is_read_as_protobuf_reads_it():
    for path in FILES:
        for record in iter_records(path):
            if record.number % 10 == 5:
                compare(record.data)


@pytest.mark.slow
def test_every_shared_record_is_a_scene():
    listed = json.loads((SHARED / "manifest.json").read_text())
    ids = [entry["scenario_id"] for split in listed.values() for entry in split]

    command = [sys.executable, "-c", LIST_IDS, *map(str, FILES)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)

    assert sorted(done.stdout.split()) == sorted(ids)


def test_logs_of_other_lengths_are_read():
    lengths = {
        scene.tracks.num_steps
        for name in ("long_20s", "truncated")
        for path in SHARED.glob(f"{name}.*")
        for scene in islice(iter_scenes(path), 5)
    }

    assert {11, 91, 197, 200} <= lengths
