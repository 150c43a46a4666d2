import numpy as np
import pytest

from infgen.config import TokenSettings
from infgen.tokens.statistics import count, describe, no_statistics
from infgen.tokens.tokenizer import tokenize_scene


@pytest.fixture
def counted(metre_moves, bent_roads):
    def run(scene):
        return count(scene, tokenize_scene(scene, metre_moves, bent_roads, TokenSettings()))

    return run


def test_agents_are_counted_by_kind_and_by_when_they_come_and_go(counted, crossing):
    figures = counted(crossing())

    assert figures.agents.tolist() == [2, 1, 1]
    assert figures.late.tolist() == [0, 1, 0]
    assert figures.first.tolist() == [3, *[0] * 5, 1, *[0] * 11]
    assert figures.last.tolist() == [*[0] * 11, 1, *[0] * 5, 3]


def test_newcomers_are_counted_per_half_second_after_the_history(counted, crossing):
    figures = counted(crossing())

    assert figures.entering[:2].tolist() == [15, 1]
    assert figures.entering.sum() == 16
    assert figures.beyond == 0


def test_errors_are_distances_from_the_log_at_the_end_of_moves(counted, drive):
    # 4.5 m each token step in moves of whole metres: ends are 0 or 0.5 m off.
    figures = counted(drive(speed_mps=9.0))

    assert figures.error[0].sum() == 17
    assert figures.error[0, :3].sum() + figures.error[0, 497:503].sum() == 17
    assert figures.error[1:].sum() == 0


def test_figures_of_scenes_add_up_whatever_their_length(counted, drive, crossing):
    both = counted(drive(steps=31)) + counted(crossing())

    assert both.scenes == 2
    assert both.tokens == 6 + 18
    assert both.agents.tolist() == [3, 1, 1]
    assert both.last[5] == 1
    assert len(both.last) == 18


def test_nothing_adds_nothing(counted, crossing):
    figures = counted(crossing())
    same = no_statistics() + figures

    np.testing.assert_array_equal(same.first, figures.first)
    np.testing.assert_array_equal(same.error, figures.error)
    assert same.words == figures.words


def test_a_description_says_shares_and_means(counted, crossing):
    said = describe(counted(crossing()))

    assert said["agents"] == {"vehicle": 2, "pedestrian": 1, "cyclist": 1}
    assert said["share_entering_after_now"] == 0.25
    assert said["entries_per_token_in_grid"] == pytest.approx(1 / 16)
    assert said["matching_error_m"]["vehicle"]["p99"] < 0.01


def test_nothing_can_be_described_too():
    assert describe(no_statistics())["matching_error_m"]["cyclist"] == {"moves": 0}
