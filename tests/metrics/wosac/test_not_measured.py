"""What a source does not record is not measured: it is no proof that nothing happened."""

import math
from dataclasses import replace

import numpy as np
import pytest

from infgen.metrics.wosac import metric
from infgen.metrics.wosac.logged import LogError, from_scene
from infgen.metrics.wosac.rollouts import Rollouts, RolloutsError
from infgen.metrics.wosac.versions import VERSIONS
from infgen.scene import AgentType, FeatureType

RED = ("traffic_light_violation_likelihood", "simulated_traffic_light_violation_rate")
EDGE = (
    "distance_to_road_edge_likelihood",
    "offroad_indication_likelihood",
    "simulated_offroad_rate",
)


def futures(log, count=2) -> Rollouts:
    """Rollouts in which everyone stands where it is now."""
    rows = log.sim_rows
    still = {
        name: np.tile(getattr(log, name)[rows, 10][None, :, None], (count, 1, 80))
        for name in ("x_m", "y_m", "z_m", "heading_rad")
    }
    return Rollouts(log.scenario_id, log.id[rows].astype(np.int64), **still)


def scored(scene, version="wosac-2025"):
    log = from_scene(scene)
    return metric.score(log, futures(log), version).numbers()


def unmeasured(numbers):
    return {name for name, value in numbers.items() if math.isnan(value)}


@pytest.fixture
def bare(crossing, build_map):
    """A scene whose map has one lane and no edge."""
    lane = np.column_stack([np.arange(-50.0, 50.0), np.zeros(100), np.zeros(100)])
    return crossing(road_map=build_map([(1, FeatureType.LANE, 2, lane)]))


def test_red_lights_are_not_measured_where_the_source_records_none(crossing):
    official = scored(crossing())
    found = scored(replace(crossing(), lights_recorded=False))

    assert unmeasured(official) == set()  # A scene of WOMD without lights has none.
    assert unmeasured(found) == set(RED)
    same = {name for name in official if found[name] == official[name]}
    assert set(official) - same == {*RED, "metametric", "map_based_metrics"}


def test_the_metametric_is_the_weighted_mean_of_what_is_measured(crossing):
    found = scored(replace(crossing(), lights_recorded=False))
    rules = VERSIONS["wosac-2025"].rules
    rules = [rule for rule in rules if f"{rule.feature}_likelihood" not in RED]

    total = sum(rule.weight * found[f"{rule.feature}_likelihood"] for rule in rules)
    assert found["metametric"] == pytest.approx(total / 0.95, abs=1e-6)
    edges = [r for r in rules if r.bucket == "map_based"]
    total = sum(rule.weight * found[f"{rule.feature}_likelihood"] for rule in edges)
    assert found["map_based_metrics"] == pytest.approx(total / 0.3, abs=1e-6)


def test_lights_that_weigh_nothing_change_no_metametric(crossing):
    official = scored(crossing(), "wosac-2024")
    found = scored(replace(crossing(), lights_recorded=False), "wosac-2024")

    assert found["metametric"] == official["metametric"]


def test_without_road_edges_there_is_neither_a_map_score_nor_a_metametric(bare):
    assert unmeasured(scored(bare)) == {*EDGE, "map_based_metrics", "metametric"}
    nothing = scored(replace(bare, lights_recorded=False))
    assert unmeasured(nothing) == {*EDGE, *RED, "map_based_metrics", "metametric"}


def test_scenario_generation_does_not_measure_it_either(crossing):
    log = from_scene(replace(crossing(), lights_recorded=False))
    rows = log.sim_rows
    whole = {
        name: np.repeat(getattr(log, name)[None, rows], 2, axis=0)
        for name in ("x_m", "y_m", "z_m", "heading_rad")
    }
    given = Rollouts(log.scenario_id, log.id[rows].astype(np.int64), **whole)

    found = metric.score(log, given, "wosac-2025-scenario-gen").numbers()
    assert unmeasured(found) == set(RED)


def test_the_mean_over_scenes_is_of_those_that_have_the_score(crossing, bare):
    parts = [crossing(), replace(crossing(), lights_recorded=False), bare]
    logs = [from_scene(part) for part in parts]
    scores = [metric.score(log, futures(log)) for log in logs]

    mean = metric.mean_scores(scores)
    lights = [scores[at].traffic_light_violation_likelihood for at in (0, 2)]
    assert mean.traffic_light_violation_likelihood == pytest.approx(np.mean(lights))
    assert math.isnan(metric.mean_scores(scores[2:]).metametric)


def with_others(scene, rows):
    """The scene with some agents turned into cones."""
    agent_type = scene.tracks.agent_type.copy()
    agent_type[rows] = AgentType.OTHER
    return replace(scene, tracks=replace(scene.tracks, agent_type=agent_type))


def without(given, ids):
    kept = ~np.isin(given.object_id, ids)
    cut = {
        name: getattr(given, name)[:, kept] for name in ("x_m", "y_m", "z_m", "heading_rad")
    }
    return replace(given, object_id=given.object_id[kept], **cut)


def test_agents_of_type_other_need_no_rollouts(crossing):
    cone = int(crossing().tracks.id[1])
    scene = replace(
        with_others(crossing(), [1]),
        predict_row=np.array([0, 1], np.int32),
        predict_difficulty=np.zeros(2, np.int8),
    )
    log = from_scene(scene)

    found = metric.score(log, without(futures(log), [cone]))
    valid = scene.tracks.valid.copy()
    valid[1] = False
    never = replace(
        scene,
        tracks=replace(scene.tracks, valid=valid),
        predict_row=np.array([0], np.int32),
        predict_difficulty=np.zeros(1, np.int8),
    )
    assert found.numbers() == scored(never)  # As if the cone were not there.


def test_agents_of_type_other_that_are_simulated_are_scored(crossing):
    log = from_scene(with_others(crossing(), [1, 3]))
    given = futures(log)

    assert metric.score(log, given).metametric > 0
    with pytest.raises(RolloutsError, match="1 agents missing of 3 observed now"):
        metric.score(log, without(given, log.id[[1]]))


def test_the_recording_car_stays_whatever_its_type(crossing):
    log = from_scene(with_others(crossing(), [0, 3])).road_users_only()

    assert log.id.tolist() == crossing().tracks.id[:3].tolist()
    assert log.ego == 0


def nobody_to_predict(scene):
    none = np.zeros(0, np.int32)
    return replace(scene, predict_row=none, predict_difficulty=none.astype(np.int8))


def test_without_tracks_to_predict_those_that_move_farthest_are_evaluated(build_scene):
    steps = 91
    speeds = [10.0, *np.linspace(0.0, 9.0, 12)]
    paths = np.zeros((13, steps, 3))
    paths[:, :, 0] = np.array(speeds)[:, None] * 0.1 * np.arange(steps)
    paths[:, :, 1] = 10.0 * np.arange(13)[:, None]
    kinds = [AgentType.VEHICLE] * 13
    kinds[1] = AgentType.PEDESTRIAN  # Stands, and is the only one of its type.
    kinds[12] = AgentType.OTHER  # The fastest but for the ego.
    valid = np.ones((13, steps), bool)
    valid[11, 40:] = False  # Not seen long enough.
    valid[10, 10] = False  # Not seen now.
    scene = nobody_to_predict(build_scene(paths, kinds, valid))

    log = from_scene(scene)
    assert log.predict_row.tolist() == [1, 3, 4, 5, 6, 7, 8, 9]
    assert metric.score(log, futures(log)).metametric > 0


def test_tracks_that_the_record_names_are_kept(crossing):
    assert from_scene(crossing()).predict_row.tolist() == [0]
    assert 0 not in from_scene(nobody_to_predict(crossing())).predict_row


def test_a_log_with_another_history_is_refused_with_the_way_out(crossing):
    with pytest.raises(LogError, match=r"ingest\.now_step=10 sets it in scene files"):
        from_scene(crossing(now=20))
