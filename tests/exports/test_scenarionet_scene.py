"""A scene written as ScenarioNet's and read again is the same scene."""

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from infgen.exports.scenarionet_scene import NotWritableError, describe_scene, write_scene
from infgen.scene import Scene, SignalState
from infgen.sources import scenarionet
from infgen.sources.scenarionet.pickles import pickled, unpickle
from infgen.sources.scene_files import SceneFiles
from infgen.sources.towns import builtin_records
from infgen.sources.womd import iter_scenes
from tests.exports.replays import decoded_small
from tests.sources.test_womd import differences


def again(scene: Scene) -> Scene:
    return scenarionet.decode(unpickle(pickled(describe_scene(scene)))).scene


def test_a_small_record_of_all_kinds_of_features_comes_back():
    assert differences(again(decoded_small()), decoded_small()) == []


def test_a_town_comes_back():
    scene = next(iter_scenes(builtin_records()[-1]))

    assert differences(again(scene), scene) == []


@settings(max_examples=30, phases=[Phase.explicit, Phase.generate])
@given(
    rows=st.dictionaries(
        st.tuples(st.integers(0, 40), st.sampled_from([1, 5, -3])),
        st.sampled_from(SignalState),
        max_size=20,
    ),
    seed=st.integers(0, 2**32 - 1),
)
def test_lights_come_back_in_any_order_and_with_moving_stop_points(
    crossing, build_signals, rows, seed
):
    draw = np.random.default_rng(seed)
    order = draw.permutation(len(rows))
    mixed = [(*key, rows[key]) for key in (list(rows)[at] for at in order)]
    signals = build_signals(sorted(mixed, key=lambda row: row[0]))
    signals.stop_xyz_m[:] = draw.integers(-99, 99, signals.stop_xyz_m.shape)
    scene = crossing(signals=signals, steps=41)

    assert differences(again(scene).signals, scene.signals) == []


def test_the_split_is_written_and_read(tmp_path, crossing):
    path = tmp_path / "sd_made_1.pkl"
    write_scene(path, crossing(), "validation")

    label = scenarionet.label(SceneFiles("x", (str(path),)))

    assert label == ("validation", "made-by-hand")


def test_two_lights_of_one_lane_in_one_step_cannot_be_written(crossing, build_signals):
    scene = crossing(
        signals=build_signals([(3, 1, SignalState.GO), (3, 1, SignalState.STOP)])
    )

    with pytest.raises(NotWritableError, match="lane 1 has two lights"):
        describe_scene(scene)
