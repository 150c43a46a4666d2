"""Long-term features and scores against those of the paper's public code, where they agree.

Slips of that code (SPEC 8.2) are not repeated, so only what they do not touch is compared.
"""

import json

import numpy as np
import pytest

from infgen.metrics.interaction import nearest_object_m, time_to_collision_s
from infgen.metrics.kinematics import measure_kinematics
from infgen.metrics.long_term.binned import Binned, bin_traffic
from infgen.metrics.long_term.metric import score_binned
from infgen.metrics.long_term.protocols import FEATURES, MAX_BINS, NUM_FEATURES, ROW
from infgen.metrics.motion import Motion
from infgen.metrics.placement import Events
from infgen.metrics.traffic import Traffic
from infgen.metrics.windows import cut_windows
from tests.metrics.golden import GOLDEN

FOLDER = GOLDEN.parent / "long_term_reference"
FUTURE = slice(11, 311)
PAPER = 0
# Our names of features that the public code calls otherwise.
PUBLIC = {
    "num_entries": "num_placement",
    "num_exits": "num_removement",
    "exit_distance": "distance_removement",
}
pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason=f"the public code's values are not at {FOLDER}"
)


def load(name):
    with np.load(FOLDER / f"{name}.npz") as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def traffic() -> Traffic:
    raw = load("rollout_A")
    state, ego = (
        raw["pred_state"][:, 2:],
        int(np.flatnonzero(raw["agent_id"] == raw["av_id"])[0]),
    )
    away = raw["token_pos"] - raw["token_pos"][ego]
    distance = np.linalg.norm(away, axis=-1)[:, 2:].astype(np.float32)
    state[ego] = -1
    events = []
    for presence in (2, 3):
        agent, token = np.nonzero(state == presence)
        events += [token.astype(np.int16), distance[agent, token]]
    return Traffic(
        scenario_id="A",
        index=0,
        now=10,
        ego=ego,
        motion=Motion(
            x_m=raw["pred_traj"][None, ..., 0],
            y_m=raw["pred_traj"][None, ..., 1],
            z_m=raw["pred_z"][None],
            heading_rad=raw["pred_head"][None],
            size_lwh_m=raw["pred_shape"],
            agent_type=raw["pred_type"].astype(np.int8),
            valid=raw["pred_valid"][None],
        ),
        events=Events(*events),
    )


@pytest.fixture(scope="module")
def official():
    return load("sim_features_A")


def test_kinematics_of_all_agents_over_thirty_seconds(traffic, official):
    motion = traffic.motion
    found = measure_kinematics(motion.x_m, motion.y_m, motion.z_m, motion.heading_rad)

    for ours, name in (
        (found.speed_mps, "linear_speed"),
        (found.accel_mps2, "linear_acceleration"),
        (found.yaw_rate_rad_s, "angular_speed"),
        (found.yaw_accel_rad_s2, "angular_acceleration"),
    ):
        # Steps of absent agents are the world's zero, kilometres away.
        np.testing.assert_allclose(ours[0, :, FUTURE], official[name], rtol=1e-5, atol=1e-4)


def test_interactions_of_all_agents_over_thirty_seconds(traffic, official):
    every = np.arange(traffic.motion.num_agents)
    nearest_m = nearest_object_m(traffic.motion, every, FUTURE)[0]
    ttc_s = time_to_collision_s(traffic.motion, every, FUTURE)[0]

    expected = official["distance_to_nearest_object"]
    np.testing.assert_allclose(nearest_m, expected, rtol=1e-5, atol=2e-3)
    np.testing.assert_array_equal(nearest_m < 0, official["collision_per_step"])
    np.testing.assert_allclose(ttc_s, official["time_to_collision"], rtol=1e-4, atol=1e-4)


@pytest.fixture(scope="module")
def binned(traffic) -> Binned:
    return bin_traffic(traffic, None, 75.0, as_logged=True)


@pytest.fixture(scope="module")
def scores(binned):
    published = json.loads((FOLDER / "log_distributions.json").read_text())
    log_p = np.full((2, NUM_FEATURES, MAX_BINS), -np.inf)
    for row, feature in enumerate(FEATURES):
        name = PUBLIC.get(feature.name, feature.name)
        shares = published.get(name, [0.1] * feature.histogram.bins)
        log_p[:, row, : len(shares)] = np.log(shares)
    return score_binned(binned, log_p, cut_windows(300, 8.0, 0.5))


# Speeds and accelerations differ by two slips: the public code counts what is beyond the
# range in the first bin, and forgets at the first step that there is a history.
COMPARED = (
    "angular_speed",
    "distance_to_nearest_object",
    "time_to_collision",
    *PUBLIC,
)


@pytest.mark.parametrize("feature", COMPARED)
def test_scores_and_their_curves_are_those_of_the_public_code(scores, feature):
    published = json.loads((FOLDER / "metrics_A.json").read_text())["A"]
    name = f"{PUBLIC.get(feature, feature)}_likelihood"

    assert scores.overall[PAPER, ROW[feature]] == pytest.approx(
        published["scalar"][name], abs=1e-4
    )
    curve = scores.windows[PAPER, ROW[feature]]
    np.testing.assert_allclose(curve, published["long"][name], atol=1e-4)


def test_the_public_code_loses_entry_distances_and_we_do_not(scores):
    published = json.loads((FOLDER / "metrics_A.json").read_text())["A"]["scalar"]

    assert published["distance_placement_likelihood"] == 0
    assert scores.overall[PAPER, ROW["entry_distance"]] > 0
