"""Scores by name: those of the stages, and errors that say what to do."""

import numpy as np
import pytest

import infgen
from infgen.config import ReferenceSettings, ScoreSettings, TokenSettings
from infgen.errors import ConfigError
from infgen.metrics.long_term.protocols import PROTOCOLS
from infgen.metrics.wosac import metric as wosac
from pipeline.stages.reference import measure_log
from pipeline.stages.score.stage import _Scorer
from pipeline.stages.score.summary import Tally
from tests.exports.replays import replay


@pytest.fixture(scope="module")
def reference(builtin):
    return infgen.open_reference(builtin[2:5])


def test_long_term_scores_are_those_of_the_stage(rollouts, reference):
    settings = {"reference": ReferenceSettings(), "score": ScoreSettings(proper=False)}
    scorer = _Scorer(reference.against, [], False, settings)
    scorer.take(rollouts.scene, rollouts.rollouts)
    scorer.tally.close_unit()
    expected = scorer.tally.means[rollouts.scene.scenario_id]

    for protocol in (each.name for each in PROTOCOLS):
        found = rollouts.score(protocol, reference=reference)
        assert found["composite"] == expected[f"{protocol}/composite"]
        assert found["agents/near"] == expected["agents/near"]
        assert not [name for name in found if name.startswith(("paper/", "corrected/"))]
    assert isinstance(scorer.tally, Tally)


def test_a_reference_holds_what_its_logs_add_up_to(builtin, reference):
    one = measure_log(builtin[2], TokenSettings(), ReferenceSettings())[1]

    logs = reference.against.logs
    assert set(logs) == set(builtin[2:5].scenario_ids)
    np.testing.assert_array_equal(logs[one.scenario_id].near, one.num_near)
    assert reference.against.split_near == pytest.approx(
        np.mean([log.near.mean() for log in logs.values()]), rel=0.02
    )


def test_a_replayed_log_has_no_displacement(scene):
    rollouts = infgen.SceneRollouts(scene, (replay(scene), replay(scene, index=1)))

    scores = infgen.score(rollouts, scene)

    log, given = wosac.from_scene(scene), wosac.from_rollouts(rollouts.rollouts)
    assert dict(scores) == wosac.score(log, given).numbers()
    assert rollouts.score() == scores
    table = scores.to_polars()
    assert table.height == 1
    assert table["metametric"].item() == scores["metametric"]
    assert table["scenario_id"].item() == scene.scenario_id


def test_what_cannot_be_scored_is_told_with_the_way_out(rollouts, scene):
    with pytest.raises(ConfigError, match="no metric 'wosac-2052'; did you mean"):
        infgen.score(rollouts, scene, metric="wosac-2052")
    with pytest.raises(ConfigError, match=r"expected reference=infgen\.open_reference"):
        rollouts.score("paper")
    with pytest.raises(ConfigError, match="generated from their first step on"):
        rollouts.score("wosac-2025-scenario-gen")
    with pytest.raises(wosac.RolloutsError, match=r"missing .*mode='wosac'"):
        rollouts.score()


def test_logs_that_are_too_short_make_no_reference(drive, tmp_path):
    with pytest.raises(ConfigError, match="no log can be measured: 40 steps hold"):
        infgen.open_reference([drive(steps=40)])
    (tmp_path / "store").mkdir()
    with pytest.raises(ConfigError, match="holds no reference; `infgen reference"):
        infgen.open_reference(tmp_path)
