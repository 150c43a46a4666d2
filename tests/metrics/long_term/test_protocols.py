"""The numbers of the long-term protocols never change: others need another name."""

import numpy as np
import pytest

from infgen.metrics.long_term.protocols import (
    COMPOSITE_WEIGHTS,
    CORRECTED,
    FEATURES,
    PAPER,
    PROTOCOLS,
    simulated_boxes,
)

FROZEN_FEATURES = [
    ("linear_speed", "kinematic", 0.05, 0.0, 25.0, 10),
    ("linear_acceleration", "kinematic", 0.05, -12.0, 12.0, 11),
    ("angular_speed", "kinematic", 0.05, -0.628, 0.628, 11),
    ("angular_acceleration", "kinematic", 0.05, -3.14, 3.14, 11),
    ("distance_to_nearest_object", "interactive", 0.1, -5.0, 40.0, 10),
    ("collision_indication", "interactive", 0.25, -0.5, 1.5, 2),
    ("time_to_collision", "interactive", 0.1, 0.0, 5.0, 10),
    ("distance_to_road_edge", "map", 0.1, -20.0, 40.0, 10),
    ("offroad_indication", "map", 0.25, -0.5, 1.5, 2),
    ("num_entries", "placement", 0.1, 0.0, 10.0, 5),
    ("num_exits", "placement", 0.1, 0.0, 10.0, 5),
    ("entry_distance", "placement", 0.1, 0.0, 75.0, 10),
    ("exit_distance", "placement", 0.1, 0.0, 75.0, 10),
]
FROZEN_PROTOCOLS = {
    "paper": (((4.3, 1.8), (0.5, 0.5), (1.9, 0.5)), False, 1, True, float("inf"), 2),
    "corrected": (None, True, 10, False, 75.0, 1),
}


def test_features_bins_and_weights_are_those_of_the_spec():
    found = [
        (f.name, f.bucket, f.weight, f.histogram.low, f.histogram.high, f.histogram.bins)
        for f in FEATURES
    ]

    assert found == FROZEN_FEATURES
    assert all(f.histogram.pseudocount == 0.1 for f in FEATURES)


def test_the_composite_weighs_buckets_as_published():
    assert COMPOSITE_WEIGHTS == {
        "kinematic": 0.2,
        "interactive": 0.45,
        "map": 0.35,
        "placement": 0.4,
    }


def test_protocols_are_those_that_results_were_published_with():
    found = {
        p.name: (
            p.boxes_lw_m,
            p.keep_ends,
            p.min_steps,
            p.absent_is_safe,
            p.event_radius_m,
            p.unseen_tokens,
        )
        for p in PROTOCOLS
    }

    assert found == FROZEN_PROTOCOLS


def test_the_papers_boxes_depend_on_the_kind_alone_and_keep_heights():
    own = np.array([[5.0, 2.0, 1.5], [0.8, 0.8, 1.7], [1.8, 0.7, 1.6]], dtype=np.float32)
    agent_type = np.array([0, 1, 2], dtype=np.int8)

    paper = simulated_boxes(PAPER, agent_type, own)

    expected = [[4.3, 1.8, 1.5], [0.5, 0.5, 1.7], [1.9, 0.5, 1.6]]
    np.testing.assert_allclose(paper, expected, rtol=1e-6)
    assert simulated_boxes(CORRECTED, agent_type, own) is own


@pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda protocol: protocol.name)
def test_both_outcomes_of_an_event_have_their_own_bin(protocol):
    events = [f for f in FEATURES if f.histogram.bins == 2]

    for feature in events:
        assert feature.histogram.edges.tolist() == [-0.5, 0.5, 1.5]
