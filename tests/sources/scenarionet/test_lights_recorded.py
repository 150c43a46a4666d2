"""Whether a scene without lights has none, or its source records none."""

from dataclasses import replace

import pytest

from infgen.exports.scenarionet_scene import describe_scene
from infgen.scene import SignalState
from infgen.sources import scenarionet
from infgen.sources.scenarionet.pickles import pickled, unpickle


def read_back(description):
    return scenarionet.decode(unpickle(pickled(description))).scene


@pytest.mark.parametrize("recorded", [True, False])
def test_a_written_scene_keeps_whether_lights_are_recorded(drive, recorded):
    scene = replace(drive(), lights_recorded=recorded)

    assert read_back(describe_scene(scene)).lights_recorded is recorded


@pytest.mark.parametrize(
    ("dataset", "recorded"),
    [("waymo", True), ("nuplan", True), ("nuscenes", False), ("another", False)],
)
def test_a_data_set_records_lights_or_not(drive, dataset, recorded):
    description = describe_scene(drive())
    description["metadata"]["dataset"] = dataset

    assert read_back(description).lights_recorded is recorded


def test_a_scene_with_lights_records_them_whatever_its_data_set(drive, build_signals):
    scene = drive(signals=build_signals([(3, 1, SignalState.GO)]))
    description = describe_scene(scene)
    description["metadata"]["dataset"] = "another"

    assert read_back(description).lights_recorded
