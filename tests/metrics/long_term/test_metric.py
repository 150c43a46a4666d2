import numpy as np
import pytest

from infgen.metrics.long_term.binned import NO_BIN, Binned
from infgen.metrics.long_term.metric import (
    BUCKETS,
    bucket_scores,
    composite,
    score_binned,
)
from infgen.metrics.long_term.protocols import (
    FEATURES,
    MAX_BINS,
    NUM_FEATURES,
    PROTOCOLS,
    ROW,
    STEP_FEATURES,
)
from infgen.metrics.long_term.reference import (
    Counts,
    add_up,
    count_log,
    count_simulated,
    divergence,
    log_probabilities,
    no_counts,
)
from infgen.metrics.windows import cut_windows

PAPER, CORRECTED = range(2)
ONE = cut_windows(80, 8.0, 0.5)


def binned(agents=2, steps=80, there=None, **bins) -> Binned:
    """Everyone in bin 0 of every feature; ``speed=[...]`` per agent, or arrays."""
    values = np.zeros((2, len(STEP_FEATURES), agents, steps), np.uint8)
    for name, value in bins.items():
        if name in ROW:
            values[:, ROW[name]] = np.broadcast_to(np.asarray(value), (agents, steps))
    present = np.ones((agents, steps), bool) if there is None else np.asarray(there, bool)
    values[:, :, ~present] = NO_BIN
    nothing = np.zeros(0, np.int16), np.zeros(0, np.float32)
    entries, exits = bins.get("entries", nothing), bins.get("exits", nothing)
    number = present.sum(axis=0).astype(np.int16) - 1
    return Binned(
        scenario_id="made",
        index=0,
        there_now=bins.get("there_now", np.ones(agents, bool)),
        bins=values,
        entry_token=np.asarray(entries[0], np.int16),
        entry_distance_m=np.asarray(entries[1], np.float32),
        exit_token=np.asarray(exits[0], np.int16),
        exit_distance_m=np.asarray(exits[1], np.float32),
        num_near=number,
        num_all=number,
    )


def log_p(**shares):
    """Log-probabilities with given values of some features' first bins."""
    found = np.full((2, NUM_FEATURES, MAX_BINS), np.log(0.5))
    for name, share in shares.items():
        found[:, ROW[name], : len(share)] = np.log(share)
    return found


def score(one, windows=ONE, **shares):
    return score_binned(one, log_p(**shares), windows)


def test_an_agents_likelihood_is_the_geometric_mean_over_its_steps():
    half = np.repeat([0, 1], 40)
    found = score(binned(1, linear_speed=half), linear_speed=[0.4, 0.1])

    np.testing.assert_allclose(found.overall[:, ROW["linear_speed"]], 0.2)


def test_agents_are_averaged_arithmetically():
    speeds = [[0] * 80, [1] * 80]
    found = score(binned(2, linear_speed=speeds), linear_speed=[0.4, 0.1])

    np.testing.assert_allclose(found.overall[:, ROW["linear_speed"]], 0.25)


def test_an_agent_seen_for_a_few_steps_counts_on_paper_only():
    there = np.ones((2, 80), bool)
    there[1, 9:] = False
    speeds = [[0] * 80, [1] * 80]
    found = score(binned(2, there=there, linear_speed=speeds), linear_speed=[0.4, 0.1])

    assert found.overall[PAPER, ROW["linear_speed"]] == pytest.approx(0.25)
    assert found.overall[CORRECTED, ROW["linear_speed"]] == pytest.approx(0.4)


def test_one_collision_in_a_window_is_a_collision_of_the_window():
    crash = np.zeros((2, 80), np.uint8)
    crash[0, 17] = 1
    found = score(binned(2, collision_indication=crash), collision_indication=[0.9, 0.1])

    expected = np.sqrt(0.9 * 0.1)
    np.testing.assert_allclose(found.overall[:, ROW["collision_indication"]], expected)


def test_absent_agents_are_safe_on_paper_and_do_not_count_when_corrected():
    there = np.ones((2, 80), bool)
    there[1] = False
    crash = np.zeros((2, 80), np.uint8)
    crash[0, 17] = 1
    one = binned(2, there=there, collision_indication=crash)
    found = score(one, collision_indication=[0.9, 0.1])

    row = ROW["collision_indication"]
    assert found.overall[PAPER, row] == pytest.approx(np.sqrt(0.9 * 0.1))
    assert found.overall[CORRECTED, row] == pytest.approx(0.1)


def test_windows_slide_by_half_a_second():
    crash = np.zeros((1, 100), np.uint8)
    crash[0, 3] = 1  # in the first half second: only the first of five windows holds it
    windows = cut_windows(100, 8.0, 0.5)
    one = binned(1, steps=100, collision_indication=crash)
    found = score(one, windows, collision_indication=[0.9, 0.1])

    expected = [0.1, 0.9, 0.9, 0.9, 0.9]
    np.testing.assert_allclose(
        found.windows[CORRECTED, ROW["collision_indication"]], expected
    )
    overall = found.overall[CORRECTED, ROW["collision_indication"]]
    assert overall == pytest.approx(np.prod(expected) ** 0.2)


def test_numbers_of_entries_and_exits_by_hand():
    # Three enter in one token step (bin 1: 2 or 3), nobody in the other fifteen.
    entries = ([4, 4, 4], [10, 20, 30])
    found = score(binned(entries=entries), num_entries=[0.5, 0.125])

    expected = np.exp((15 * np.log(0.5) + np.log(0.125)) / 16)
    np.testing.assert_allclose(found.overall[:, ROW["num_entries"]], expected)
    np.testing.assert_allclose(found.overall[:, ROW["num_exits"]], 0.5)


def test_far_entries_count_on_paper_only():
    found = score(binned(entries=([4, 4, 4], [90, 90, 90])), num_entries=[0.5, 0.125])

    assert found.overall[CORRECTED, ROW["num_entries"]] == pytest.approx(0.5)
    assert found.overall[PAPER, ROW["num_entries"]] < 0.5


def test_entry_distances_are_scored_by_event():
    found = score(
        binned(entries=([4, 9], [3.0, 10.0]), exits=([2], [3.0])),
        entry_distance=[0.4, 0.2],
        exit_distance=[0.3],
    )

    np.testing.assert_allclose(found.overall[:, ROW["entry_distance"]], 0.3)
    np.testing.assert_allclose(found.overall[:, ROW["exit_distance"]], 0.3)


def test_without_events_there_is_no_distance_score_and_the_bucket_counts_zero():
    found = score(binned())

    assert np.isnan(found.overall[:, ROW["entry_distance"]]).all()
    buckets = bucket_scores(found.overall)
    np.testing.assert_allclose(buckets[:, BUCKETS.index("placement")], (0.5 + 0.5) / 4)


def test_without_a_map_the_bucket_has_no_value_but_the_others_do():
    none = np.full((2, 80), NO_BIN, np.uint8)
    found = score(binned(distance_to_road_edge=none, offroad_indication=none))
    buckets = bucket_scores(found.overall)

    assert np.isnan(buckets[:, BUCKETS.index("map")]).all()
    assert not np.isnan(buckets[:, BUCKETS.index("kinematic")]).any()


def test_the_published_rows_follow_from_their_buckets():
    # Table 2 of the paper: SMART and CatK.
    rows = np.array([[0.5839, 0.7542, 0.8102, 0.4324], [0.5850, 0.7584, 0.8186, 0.4424]])

    np.testing.assert_allclose(composite(rows, placement=True), [0.6519, 0.6584], atol=1e-4)


def test_without_placement_the_composite_is_the_motion_only_one():
    # Table 3: InfGen.
    row = np.array([[0.5495, 0.7685, 0.8213, np.nan]])

    np.testing.assert_allclose(composite(row, placement=False), [0.7432], atol=1e-4)


def test_buckets_weigh_their_features():
    features = np.zeros((1, NUM_FEATURES))
    features[0, ROW["collision_indication"]] = 0.9

    interactive = bucket_scores(features)[0, BUCKETS.index("interactive")]
    assert interactive == pytest.approx(0.25 * 0.9 / 0.45)


def test_the_reference_counts_agents_there_now_in_the_first_window_only():
    later = binned(2, steps=100, there_now=np.array([True, False]))
    counts = count_log(later, cut_windows(100, 8.0, 0.5))

    assert counts.bins[PAPER, ROW["linear_speed"]].tolist() == [80] + [0] * 10
    assert counts.bins[PAPER, ROW["collision_indication"], :2].tolist() == [1, 0]


def test_the_last_half_seconds_of_a_log_are_not_counted_for_entries():
    found = count_log(binned(entries=([15, 14, 2], [5, 5, 5])), ONE)

    assert found.bins[PAPER, ROW["num_entries"]].sum() == 14
    assert found.bins[CORRECTED, ROW["num_entries"]].sum() == 15
    assert found.bins[PAPER, ROW["entry_distance"]].sum() == 1
    assert found.bins[CORRECTED, ROW["entry_distance"]].sum() == 2


def test_counts_add_up_in_any_order():
    parts = [count_simulated(binned(n, linear_speed=n), ONE) for n in (1, 2, 3)]

    one, two = add_up(parts), add_up(reversed(parts))
    np.testing.assert_array_equal(one.bins, two.bins)
    assert one.bins[PAPER, ROW["linear_speed"], 1:4].tolist() == [80, 160, 240]
    assert add_up([]).bins.sum() == 0


def test_probabilities_are_smoothed_frequencies():
    counts = no_counts()
    counts.bins[:, ROW["num_exits"], :5] = [7, 2, 1, 0, 0]
    found = np.exp(log_probabilities(counts))[PAPER]

    np.testing.assert_allclose(
        found[ROW["num_exits"], :5], np.array([71, 21, 11, 1, 1]) / 105
    )
    assert found[ROW["num_exits"], 5:].max() == 0
    for row, feature in enumerate(FEATURES):
        assert found[row, : feature.histogram.bins].sum() == pytest.approx(1.0)


def filled(*bins) -> Counts:
    counts = no_counts()
    counts.bins[:, :, : len(bins)] = bins
    return counts


def test_the_divergence_is_zero_of_equals_and_one_of_strangers():
    assert divergence(filled(3, 1), filled(30, 10)).max() == pytest.approx(0.0)
    np.testing.assert_allclose(divergence(filled(5, 0), filled(0, 2)), 1.0)
    assert np.isnan(divergence(filled(1), no_counts())).all()


def test_the_divergence_is_the_same_both_ways():
    one, two = filled(3, 1, 4), filled(1, 5, 9)

    np.testing.assert_allclose(divergence(one, two), divergence(two, one))


def test_always_the_most_common_thing_scores_above_the_log_but_diverges():
    """Why a likelihood alone is no goal."""
    random = np.random.default_rng(0)
    log = binned(50, linear_speed=random.integers(0, 4, (50, 80)))
    modal = binned(50, linear_speed=0)
    extra = count_log(binned(20, linear_speed=0), ONE)
    reference = count_log(log, ONE) + extra
    row, chances = ROW["linear_speed"], log_probabilities(reference)

    own = score_binned(log, chances, ONE).overall[CORRECTED, row]
    collapsed = score_binned(modal, chances, ONE).overall[CORRECTED, row]

    assert collapsed > own
    log_apart, modal_apart = (
        divergence(reference, count_simulated(one, ONE))[CORRECTED, row]
        for one in (log, modal)
    )
    assert modal_apart > 5 * log_apart


@pytest.mark.parametrize("protocol", range(len(PROTOCOLS)))
def test_the_order_of_agents_does_not_matter(protocol):
    random = np.random.default_rng(1)
    speeds = random.integers(0, 10, (6, 80))
    there = random.random((6, 80)) < 0.7
    order = random.permutation(6)
    chances = log_probabilities(count_simulated(binned(6, linear_speed=speeds), ONE))

    one = score_binned(binned(6, there=there, linear_speed=speeds), chances, ONE)
    two = score_binned(
        binned(6, there=there[order], linear_speed=speeds[order]), chances, ONE
    )
    np.testing.assert_allclose(one.overall[protocol], two.overall[protocol])
