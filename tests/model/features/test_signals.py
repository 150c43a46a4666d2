"""What an agent is told of the traffic lights ahead, by hand."""

import math

import pytest
import torch
from pydantic import ValidationError

from infgen.config import ModelSettings
from infgen.model.batching.batch import MapTokens
from infgen.model.features.signals import CLASSES, LONG_SINCE, StopLines, features
from infgen.tokens.scene_tokens import SignalClass
from infgen.tokens.signals import REMEMBERED

STOP, GO, CAUTION = SignalClass.STOP, SignalClass.GO, SignalClass.CAUTION
REACH_M = 20.0


def roads(pose, light, shown, follows=None):
    """Maps of one scene: map tokens with their lights, all of them real."""
    count = len(pose)
    nothing = torch.zeros((1, count), dtype=torch.int64)
    return MapTokens(
        real=torch.ones((1, count), dtype=torch.bool),
        pose=torch.tensor([pose], dtype=torch.float32),
        token=nothing,
        point_type=nothing,
        polyline_type=nothing,
        signal=nothing,
        light=torch.tensor([light]),
        shown=torch.tensor([shown], dtype=torch.int64),
        follows=torch.tensor([follows or [False] * count]),
        picked=torch.zeros((1, count), dtype=torch.bool),
    )


def told(lines, pose=(0.0, 0.0, 0.0), token=0):
    """Read what one agent is told: {class: (nearness, token steps)}."""
    said = lines.ahead(
        torch.tensor([pose]), torch.tensor([0]), torch.tensor([token]), REACH_M
    )
    there, near, *lasting = said.view(CLASSES, 2 + LONG_SINCE).unbind(-1)
    since = torch.stack(lasting, dim=-1).sum(dim=-1)
    return {
        int(row): (pytest.approx(float(near[row]), abs=1e-6), int(since[row]))
        for row in there.nonzero()[:, 0]
    }


def test_the_line_ahead_is_told_by_its_distance():
    lines = StopLines.of(roads([(5, 0, 0)], [1], [[STOP]]))

    assert told(lines) == {STOP: (0.75, LONG_SINCE)}
    assert told(lines, (4.0, 0.5, 0.2)) != {}


@pytest.mark.parametrize(
    "pose",
    [
        (-16.0, 0.0, 0.0),  # Too far.
        (6.5, 0.0, 0.0),  # Passed.
        (0.0, 2.5, 0.0),  # On the next lane.
        (0.0, 0.0, math.radians(35)),  # Across.
        (0.0, 0.0, math.pi),  # Against.
    ],
)
def test_other_lines_are_not_told(pose):
    assert told(StopLines.of(roads([(5, 0, 0)], [1], [[STOP]])), pose) == {}


def test_a_lane_is_told_by_where_it_begins():
    lines = StopLines.of(
        roads([(5, 0, 0), (10, 0, 0)], [1, 1], [[GO]], follows=[False, True])
    )

    assert lines.pose.shape[1] == 1
    assert told(lines) == {GO: (0.75, LONG_SINCE)}
    assert told(lines, (7.0, 0.0, 0.0)) == {}


def test_road_tokens_without_a_light_are_no_lines():
    lines = StopLines.of(roads([(3, 0, 0), (5, 0, 0)], [0, 1], [[GO]]))

    assert told(lines) == {GO: (0.75, LONG_SINCE)}


def test_half_seconds_are_counted_from_the_change():
    shown = [[STOP, STOP, GO, GO, GO, GO, GO, GO]]
    lines = StopLines.of(roads([(5, 0, 0)], [1], shown))

    since = [told(lines, token=token) for token in range(10)]

    assert since[:2] == [{STOP: (0.75, LONG_SINCE)}] * 2
    assert [said[GO][1] for said in since[2:]] == [0, 1, 2, 3, 4, 4, 4, 4]


def test_what_is_shown_last_lasts_and_goes_on_being_counted():
    lines = StopLines.of(roads([(5, 0, 0)], [1], [[STOP, GO]]))

    assert [told(lines, token=token)[GO][1] for token in (1, 2, 3, 9)] == [0, 1, 2, 4]


def test_to_be_looked_away_from_is_no_change():
    lines = StopLines.of(roads([(5, 0, 0)], [1], [[STOP, GO, GO + REMEMBERED]]))

    assert told(lines, token=2) == {GO + REMEMBERED: (0.75, 1)}


def test_lanes_that_part_at_one_line_are_told_class_by_class():
    # Straight on may go, and may now; left may not; of two that may, the nearer is told.
    pose = [(5, 0, 0), (6, 0, -0.1), (5, 0.1, 0.1)]
    lines = StopLines.of(roads(pose, [1, 2, 3], [[STOP, GO], [GO, GO], [STOP, STOP]]))

    assert told(lines, token=1) == {GO: (0.75, 0), STOP: (0.75, LONG_SINCE)}


def test_scenes_without_lights_beside_others_are_told_of_none():
    one = roads([(5, 0, 0)], [1], [[STOP]])
    none = roads([(5, 0, 0)], [0], [[STOP]])
    both = MapTokens(
        *(torch.cat([getattr(one, f), getattr(none, f)]) for f in one.__slots__)
    )

    said = StopLines.of(both).ahead(
        torch.zeros((2, 3)), torch.tensor([0, 1]), torch.tensor([0, 0]), REACH_M
    )

    assert said[0].any()
    assert not said[1].any()


@pytest.mark.parametrize("shown", [[[]], []])
def test_no_lights_at_all_are_nothing(shown):
    lines = StopLines.of(roads([(5, 0, 0)], [0], shown or [[]]))

    said = lines.ahead(
        torch.zeros((2, 3)), torch.tensor([0, 0]), torch.tensor([0, 7]), REACH_M
    )

    assert said.shape == (2, features())
    assert not said.any()


@pytest.mark.parametrize("turn_rad", [0.7, -2.0])
def test_turning_and_shifting_the_world_changes_nothing(turn_rad):
    def moved(pose):
        x, y, heading = pose
        cos, sin = math.cos(turn_rad), math.sin(turn_rad)
        return (cos * x - sin * y + 40, sin * x + cos * y - 7, heading + turn_rad)

    places = [(5.0, 1.0, 0.1), (9.0, -1.0, -0.1)]
    here = StopLines.of(roads(places, [1, 2], [[STOP], [GO]]))
    there = StopLines.of(roads([moved(p) for p in places], [1, 2], [[STOP], [GO]]))

    def said(lines, pose):
        return lines.ahead(
            torch.tensor([pose]), torch.tensor([0]), torch.tensor([0]), REACH_M
        )

    x, y, heading = moved((0.5, 0.0, 0.0))
    assert len(told(here, (0.5, 0.0, 0.0))) == 2
    torch.testing.assert_close(
        said(there, (x, y, heading + 2 * math.pi)), said(here, (0.5, 0.0, 0.0))
    )


def test_the_light_ahead_needs_lights_that_change():
    with pytest.raises(
        ValidationError, match=r"signal_ahead_m is 40.*signals_each_step=true"
    ):
        ModelSettings(signal_ahead_m=40.0)
