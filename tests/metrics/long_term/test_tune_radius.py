from dataclasses import replace

import numpy as np
import pytest

from infgen.config import TokenSettings
from infgen.metrics.long_term.binned import bin_traffic
from infgen.metrics.long_term.protocols import CORRECTED, PROTOCOLS
from infgen.metrics.long_term.radius import present_within_radius
from infgen.metrics.long_term.reference import count_log, count_simulated, log_probabilities
from infgen.metrics.long_term.table import Against, make_row
from infgen.metrics.long_term.tune_radius import (
    RadiusError,
    best_radius_m,
    placement_by_radius,
)
from infgen.metrics.traffic import from_log, from_rollout
from infgen.metrics.windows import cut_windows
from infgen.spatial.road_edges import scene_road_edges
from tests.pipeline.stages.score.test_stage import as_rollout


def against_counts(counts):
    return Against(log_probabilities(counts), 0.0, 0.0, {}, 8.0, 0.5)


@pytest.fixture
def scene(parked):
    return parked()


@pytest.fixture
def driving(scene):
    """Parked cars, and an ego that drives away from them at 10 m/s."""
    rollout = as_rollout(scene)
    xyz_m = rollout.xyz_m.copy()
    xyz_m[rollout.ego, :, 0] += np.arange(rollout.num_steps)
    return replace(rollout, xyz_m=xyz_m)


@pytest.fixture
def against(scene):
    binned = bin_traffic(
        from_log(scene, TokenSettings()), scene_road_edges(scene), 75.0, as_logged=True
    )
    return against_counts(count_log(binned, cut_windows(80, 8.0, 0.5)))


@pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda protocol: protocol.name)
def test_a_radius_scores_as_the_score_stage_would_score_it(
    scene, driving, against, protocol
):
    found = placement_by_radius([driving], against, protocol, (20.0, 40.0, 60.0))

    for radius_m, value in found.items():
        lived = from_rollout(present_within_radius(driving, radius_m))
        binned = bin_traffic(lived, scene_road_edges(scene), 75.0, as_logged=False)
        row = make_row(binned, against)
        assert value == pytest.approx(row.numbers[f"{protocol.name}/placement"])


def test_the_radius_that_made_the_reference_is_found_again(scene, driving):
    windows = cut_windows(80, 8.0, 0.5)
    lived = from_rollout(present_within_radius(driving, 40.0))
    binned = bin_traffic(lived, scene_road_edges(scene), 75.0, as_logged=False)
    against = against_counts(count_simulated(binned, windows))

    found = placement_by_radius([driving], against, CORRECTED, (20.0, 40.0, 200.0))

    assert best_radius_m(found) == 40.0


def test_among_equal_radii_the_smallest_is_best_and_unknown_ones_are_left_out():
    assert best_radius_m({10.0: float("nan"), 20.0: 0.5, 30.0: 0.5, 40.0: 0.1}) == 20.0
    with pytest.raises(RadiusError, match="no radius has"):
        best_radius_m({10.0: float("nan")})


def test_rollouts_with_newcomers_or_leavers_are_refused(driving, against):
    logged = driving.logged.copy()
    logged[-1] = False
    leaves = driving.exit_step.copy()
    leaves[-1] = 50
    for wrong in (replace(driving, logged=logged), replace(driving, exit_step=leaves)):
        with pytest.raises(RadiusError, match="inserted or removed"):
            placement_by_radius([wrong], against, CORRECTED)


def test_without_rollouts_there_is_nothing_to_tune(against):
    with pytest.raises(RadiusError, match="no rollouts"):
        placement_by_radius([], against, CORRECTED)
