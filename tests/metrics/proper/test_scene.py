from dataclasses import replace

import numpy as np
import pytest

from infgen.metrics.long_term.binned import bin_traffic
from infgen.metrics.long_term.protocols import ROW
from infgen.metrics.proper.engineering.measure import SCALES, read_place
from infgen.metrics.proper.quantities import QUANTITIES, SCORES
from infgen.metrics.proper.sample import Frame, take_sample
from infgen.metrics.proper.scene import References, score_scene
from infgen.metrics.proper.split import flatten, part_sizes, split_numbers
from infgen.metrics.traffic import observe_log
from infgen.metrics.windows import cut_windows
from infgen.spatial.road_edges import scene_road_edges
from tests.metrics.proper.test_retrieval import log as known_log

RADIUS_M = 75.0
NO_REFERENCES = References([], [])


def sample(scene, seen=None, *, logged=False):
    """A log, or the same traffic as a rollout."""
    seen = observe_log(scene) if seen is None else seen
    frame = Frame(
        windows=cut_windows(80, 2.0, 2.0),
        window_s=2.0,
        radius_m=RADIUS_M,
        place=read_place(scene, RADIUS_M, logged_lights=True),
    )
    binned = bin_traffic(seen, scene_road_edges(scene), RADIUS_M, as_logged=True)
    return take_sample(seen, binned, scene.tracks.id, frame, logged=logged)


def emptied(scene):
    """The log, whose agents are all gone after now, but for the ego."""
    seen = observe_log(scene)
    valid = seen.motion.valid.copy()
    valid[:, 1:, scene.now + 1 :] = False
    return replace(seen, motion=replace(seen.motion, valid=valid))


@pytest.fixture
def scores(crossing):
    """The log twice, as its own rollouts."""
    scene = crossing()
    return score_scene(sample(scene, logged=True), [sample(scene)] * 2, NO_REFERENCES)


def test_the_log_is_a_perfect_forecast_of_itself(scores):
    assert scores.parts["model"].tolist() == [0] * len(SCORES)
    assert scores.parts["error"].tolist() == [0] * len(QUANTITIES)
    for scale in SCALES:
        logs, rollouts = (scores.parts[f"{s}/{scale.name}"] for s in ("logs", "rollouts"))
        np.testing.assert_allclose(rollouts, logs)


def test_what_never_changes_is_as_likely_as_its_pool_is_large(parked):
    scene = parked()

    found = score_scene(sample(scene, logged=True), [sample(scene)] * 2, NO_REFERENCES)

    # 2 x 20 equal outcomes of 11: ten bins, and being gone. Of events 2 equal ones of 3.
    likelihood = found.parts["log_likelihood"]
    assert likelihood[ROW["time_to_collision"]] == pytest.approx(np.log(40.1 / 41.1))
    assert likelihood[ROW["collision_indication"]] == pytest.approx(np.log(2.1 / 2.3))
    assert likelihood[ROW["num_entries"]] == pytest.approx(np.log(2.1 / 3.1))
    assert likelihood[ROW["entry_distance"]] == pytest.approx(np.log(2.1 / 2.4))


def test_as_many_as_now_misses_who_comes_and_goes(scores):
    # Of 1 pedestrian and 1 cyclist one comes at step 30, the other goes after step 60.
    persistence = dict(zip(SCORES, scores.parts["persistence"], strict=True))

    assert persistence["pedestrians"] == pytest.approx((0.05 + 3) / 4)
    assert persistence["cyclists"] == pytest.approx((0.5 + 1) / 4)
    assert persistence["vehicles"] == 0
    assert persistence["entries"] == 1 / 4
    assert persistence["exits"] == 1 / 3  # In the last window exits are not known.


def test_curves_have_a_value_per_window_and_average_to_the_parts(scores):
    curve = scores.curves["persistence/pedestrians"]

    np.testing.assert_allclose(curve, [0.05, 1.0, 1.0, 1.0], atol=1e-5)
    assert np.isnan(scores.curves["model/exits"]).tolist() == [False] * 3 + [True]


def test_an_emptied_street_is_worse_in_every_measured_part(crossing):
    scene = crossing()
    log, empty = sample(scene, logged=True), sample(scene, emptied(scene))

    found = score_scene(log, [empty] * 2, NO_REFERENCES)

    counted = dict(zip(SCORES, found.parts["model"], strict=True))
    assert counted["vehicles"] == 1
    assert counted["energy"] > 1
    gone = found.parts["log_likelihood"][ROW["time_to_collision"]]
    assert gone < np.log(0.5)


def test_references_that_are_not_given_are_not_measured(scores, crossing):
    assert np.isnan(scores.parts["climatology"]).all()
    assert np.isnan(scores.parts["context"]).all()
    scene = crossing()
    logs = [known_log(at, vehicles=(at, at, at, at)) for at in range(3)]

    found = score_scene(
        sample(scene, logged=True), [sample(scene)] * 2, References(logs, logs)
    )

    at = SCORES.index("vehicles")
    assert found.parts["climatology"][at] == pytest.approx(2 / 3 - 8 / 12)  # 0, 1, 2 and 1.
    assert found.parts["context"][at] == pytest.approx(2 / 3)  # 1 against 0, 1 and 2.


def test_numbers_of_a_split_follow_from_means_of_its_scenes(scores):
    sizes = part_sizes(3)
    table = flatten([scores.parts] * 2, sizes)
    table[0, 0] = 3.0  # CRPS of vehicles in the first of two scenes.
    start = list(sizes).index("persistence") * len(SCORES)
    table[:, start] = [2.0, 4.0]

    found = split_numbers(table.mean(axis=0, keepdims=True), sizes)

    assert found["vehicles"] == 1.5
    assert found["skill_persistence/vehicles"] == 0.5
    assert np.isnan(found["skill_climatology/vehicles"])
    assert np.isnan(found["spread_skill/vehicles"])  # No error to compare a spread with.
    assert found["w1/speed"] == 0
    assert np.isnan(found["w1/stop_duration"])  # Nobody stops.
    assert 0 < found["likelihood/composite"] < 1
