import numpy as np

from infgen.metrics.long_term.binned import bin_traffic
from infgen.metrics.long_term.protocols import ROW
from infgen.metrics.proper.outcomes import GONE, UNKNOWN, Outcomes, align, read_outcomes
from tests.metrics.proper.roads import traffic

EGO = (0.0, 0.0, 0.0, 0.0)
TTC = ROW["time_to_collision"]


def read(*paths, radius_m=np.inf, ids=None, steps=10, **more):
    seen = traffic(EGO, *paths, steps=steps + 2, **more)
    binned = bin_traffic(seen, None, 75.0, as_logged=True)
    ids = np.arange(len(paths) + 1) if ids is None else np.array(ids)
    return read_outcomes(seen, binned, ids.astype(np.int32), steps, radius_m)


def test_an_agent_is_gone_after_it_is_last_seen_but_not_in_a_gap():
    valid = np.ones((3, 12), bool)
    valid[1, 5:] = False  # Gone from the fourth step after now on.
    valid[2, 4:6] = False

    found = read((9.0, 0.0, 0.0, 1.0), (0.0, 9.0, 0.0, 1.0), valid=valid)

    assert (found.outcome[TTC, 1] == GONE).tolist() == [False] * 3 + [True] * 7
    gap = found.outcome[TTC, 2]
    assert (gap == UNKNOWN).tolist() == [False] * 2 + [True] * 2 + [False] * 6
    assert not (gap == GONE).any()


def test_agents_are_those_there_now_and_near_by_ascending_id():
    valid = np.ones((4, 12), bool)
    valid[3, :2] = False  # Comes after now.
    still = [(90.0, 0.0, 0.0, 0.0), (9.0, 0.0, 0.0, 0.0), (0.0, 9.0, 0.0, 0.0)]

    found = read(*still, ids=[7, 3, 5, 4], valid=valid, radius_m=75.0)

    assert found.id.tolist() == [5, 7]


def test_who_is_missing_in_a_rollout_is_gone_and_gaps_of_the_log_are_asked_of_none():
    logged = Outcomes(np.array([2, 5], np.int32), np.zeros((9, 2, 3), np.uint8))
    logged.outcome[:, 1, 1] = UNKNOWN
    member = Outcomes(np.array([5, 8], np.int32), np.full((9, 2, 3), 4, np.uint8))

    aligned = align(logged, [member])

    assert aligned.shape == (1, 9, 2, 3)
    assert (aligned[0, :, 0] == GONE).all()
    assert aligned[0, 0, 1].tolist() == [4, UNKNOWN, 4]


def test_without_road_edges_no_agent_is_gone_from_the_road():
    valid = np.ones((2, 12), bool)
    valid[1, 5:] = False

    found = read((9.0, 0.0, 0.0, 1.0), valid=valid)

    assert (found.outcome[TTC, 1] == GONE).any()
    for feature in ("distance_to_road_edge", "offroad_indication"):
        assert (found.outcome[ROW[feature]] == UNKNOWN).all()
