import json
from dataclasses import replace

import numpy as np
import pytest

from infgen.config import ReferenceSettings, TokenSettings
from infgen.metrics.agent_count import mean_counts
from infgen.metrics.long_term.binned import bin_traffic
from infgen.metrics.long_term.reference import add_up, count_log
from infgen.metrics.traffic import from_log
from infgen.metrics.windows import cut_windows
from infgen.spatial.road_edges import scene_road_edges
from pipeline.stages import reference
from pipeline.stages.reference_files import (
    read_against,
    read_binned,
    read_counts,
    read_courses,
    read_logged,
)
from tests.pipeline.stages.score.test_stage import REFERENCE, Inputs, ingested

FILES = [f"validation.tfrecord-0000{at}-of-00002" for at in range(2)]


@pytest.fixture
def scenes(crossing, parked):
    return [
        replace(crossing(), scenario_id="crossing"),
        replace(parked(), scenario_id="parked"),
        replace(crossing(speed_mps=6.0), scenario_id="slow"),
    ]


@pytest.fixture
def inputs(tmp_path, scenes):
    logs = [
        ingested(tmp_path / "one", scenes[:2], FILES[0]),
        ingested(tmp_path / "two", scenes[2:], FILES[1]),
        ingested(tmp_path / "train", scenes, "training.tfrecord-00000-of-00001"),
    ]
    found = Inputs(logs, [])
    found.report = found.refer(tmp_path / "reference")
    return found


def counted(scenes):
    """Logged counts of some scenes, as defined."""
    found = []
    for scene in scenes:
        binned = bin_traffic(
            from_log(scene, TokenSettings()), scene_road_edges(scene), 75.0, as_logged=True
        )
        found.append(count_log(binned, cut_windows(binned.bins.shape[-1], 8.0, 0.5)))
    return add_up(found)


def test_it_is_made_of_the_logs_of_its_split_only(inputs):
    assert [unit.name for unit in reference.plan(inputs, REFERENCE)] == FILES
    assert inputs.report == {"logs": 3, "skipped": 0}


def test_another_split_is_a_setting(inputs):
    settings = {**REFERENCE, "reference": ReferenceSettings(split="training")}

    (unit,) = reference.plan(inputs, settings)

    assert unit.name.startswith("training")


def test_its_counts_are_those_of_all_its_logs(inputs, scenes):
    found = read_counts(inputs.reference)

    np.testing.assert_array_equal(found.bins, counted(scenes).bins)


def test_every_log_s_numbers_of_agents_are_kept_beside_its_unit(inputs):
    for done in inputs.units("reference"):
        kept = read_logged(done.path)
        assert list(kept) == [one.scenario_id for one in read_binned(done.path)]
        for one in read_binned(done.path):
            np.testing.assert_array_equal(kept[one.scenario_id].near, one.num_near)


def test_the_split_s_means_are_over_the_logs_first_windows(inputs):
    against = read_against(inputs.reference, {}, ReferenceSettings())
    windows = cut_windows(80, 8.0, 0.5)
    logs = [read_logged(done.path) for done in inputs.units("reference")]
    near = [mean_counts(one.near, windows)[0] for unit in logs for one in unit.values()]

    assert against.split_near == pytest.approx(np.mean(near))


def test_a_log_too_short_for_a_window_is_skipped_by_name(tmp_path, scenes, crossing):
    short = replace(crossing(steps=50), scenario_id="short")
    inputs = Inputs([ingested(tmp_path / "l", [*scenes, short])], [])

    report = inputs.refer(tmp_path / "reference")

    assert report == {"logs": 3, "skipped": 1}
    (done,) = inputs.units("reference")
    assert done.report["skipped"] == {"short": "50 steps hold no window of 8 s"}


def test_logs_too_short_for_a_window_make_an_empty_reference(tmp_path, crossing):
    inputs = Inputs([ingested(tmp_path / "logs", [crossing(steps=40)])], [])
    report = inputs.refer(tmp_path / "reference")

    assert report == {"logs": 0, "skipped": 1}
    assert np.isnan(read_against(inputs.reference, {}, ReferenceSettings()).split_near)
    assert json.loads((inputs.reference / "means.json").read_text())["near"] == "nan"


def test_the_same_logs_give_the_same_bytes(tmp_path, inputs):
    first = inputs.reference
    inputs.refer(tmp_path / "again")

    files = [path for path in sorted(first.rglob("*")) if path.is_file()]
    assert len(files) == 3
    for path in files:
        other = inputs.reference / path.relative_to(first)
        assert path.read_bytes() == other.read_bytes(), path


def test_courses_of_the_logs_are_kept_for_climatology_and_retrieval(inputs):
    kept = read_courses(inputs.reference)

    assert {log.scenario_id for log in kept} == {"crossing", "parked", "slow"}
    by_name = {log.scenario_id: log.course for log in kept}
    assert by_name["parked"].present.sum(axis=(1, 2)) == pytest.approx([3.0] * 4)
    assert by_name["crossing"].windows == 4
    assert all(np.isfinite(log.context).all() for log in kept)


def test_a_log_takes_some_hundred_bytes(inputs):
    (kept, *_) = read_courses(inputs.reference)

    course = kept.course
    arrays = [kept.context, course.now, course.present, course.entries, course.exits]
    assert sum(array.nbytes for array in arrays) == 4 * (11 + 9 + 4 * (9 + 5 + 5))
