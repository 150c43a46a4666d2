import numpy as np
import pytest

from infgen.metrics.proper.split import flatten, part_sizes
from pipeline.engine.atomic import StoreError
from pipeline.stages.score import gathered
from pipeline.stages.score.gathered import read_means, read_proper_table, read_sums
from pipeline.stages.score.proper import ProperTally, write_proper
from pipeline.stages.score.summary import Tally
from pipeline.stages.score.write import SUMS, write_tally


@pytest.fixture(autouse=True)
def few_units_at_once(monkeypatch):
    monkeypatch.setattr(gathered, "UNITS_AT_ONCE", 2)


def tallied(folder, means, sums):
    folder.mkdir()
    write_tally(folder, Tally(means=means, sums=sums))
    return folder


def proper(folder, scenes):
    folder.mkdir()
    write_proper(folder, ProperTally(parts=scenes))
    return folder


def parts(random, ranks):
    return {
        name: random.normal(size=size).astype(np.float32)
        for name, size in part_sizes(ranks).items()
    }


def test_means_of_all_scenes_come_in_the_order_of_their_units(tmp_path):
    units = [
        {"b": {"speed": 1.0, "count": 2.0}, "a": {"speed": np.nan, "count": 4.0}},
        {},
        {"c": {"speed": 5.0, "count": 6.0}},
    ]
    folders = [tallied(tmp_path / str(at), one, {}) for at, one in enumerate(units)]
    found = read_means(folders)

    assert found.scenario_ids == ["b", "a", "c"]
    assert found.names == ["speed", "count"]
    np.testing.assert_array_equal(found.values, [[1, 2], [np.nan, 4], [5, 6]])
    np.testing.assert_array_equal(found.matrix(["count"]), [[2], [4], [6]])


def test_without_scenes_there_is_one_row_without_values(tmp_path):
    found = read_means([tallied(tmp_path / "none", {}, {})])

    assert found.scenario_ids == []
    assert np.isnan(found.matrix(["speed", "count"])).all()


@pytest.mark.parametrize("other", [{"count": 1.0}, {"speed": 1.0, "count": 1.0}])
def test_units_with_different_metrics_are_an_error(tmp_path, other):
    units = [{"a": {"speed": 1.0}}, {"b": other}]
    folders = [tallied(tmp_path / str(at), one, {}) for at, one in enumerate(units)]

    with pytest.raises(StoreError, match="expected speed of each; run stage score again"):
        read_means(folders)


def test_sums_add_up_window_by_window(tmp_path):
    units = [
        {"speed": np.array([[1.0, 2.0], [1.0, 1.0]])},
        {"speed": np.array([[4.0], [2.0]]), "count": np.array([[7.0, 0.0], [1.0, 0.0]])},
        {"speed": np.array([[8.0, 8.0, 8.0], [1.0, 1.0, 1.0]])},
    ]
    folders = [tallied(tmp_path / str(at), {}, one) for at, one in enumerate(units)]
    found = read_sums(folders, SUMS)

    assert list(found) == ["speed", "count"]
    np.testing.assert_array_equal(found["speed"], [[13, 10, 8], [4, 2, 1]])
    np.testing.assert_array_equal(found["count"][:, :2], [[7, 0], [1, 0]])


def test_no_units_have_no_sums():
    assert read_sums([], SUMS) == {}


@pytest.mark.parametrize("ranks", [[3, 3, 3, 3], [3, 5, 5, 2], [2, 2, 5, 5]])
def test_parts_lie_side_by_side_as_those_of_each_scene(tmp_path, ranks):
    random = np.random.default_rng(0)
    scenes = {f"s{at}": parts(random, count) for at, count in enumerate(ranks)}
    units = [
        {name: scenes[name] for name in names} for names in (["s0", "s1"], ["s2"], ["s3"])
    ]
    folders = [proper(tmp_path / str(at), one) for at, one in enumerate(units)]
    found = read_proper_table(folders)

    assert found.sizes == part_sizes(max(ranks))
    np.testing.assert_array_equal(
        found.values, flatten(list(scenes.values()), found.sizes).astype(np.float32)
    )
    np.testing.assert_array_equal(found.part("model")[2], scenes["s2"]["model"])


def test_without_scenes_there_are_no_parts(tmp_path):
    found = read_proper_table([proper(tmp_path / "none", {})])

    assert found.values.shape == (0, sum(part_sizes(1).values()))
