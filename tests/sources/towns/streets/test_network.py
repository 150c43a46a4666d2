"""What is read of netconvert's files, on a crossing of known measures."""

import numpy as np

from infgen.sources.towns.streets.network import Use


def test_lanes_stand_from_right_to_left_with_their_uses(crossing):
    uses = [lane.use for lane in crossing.edges["e0f"].lanes]

    assert uses == [Use.WALKERS, Use.NO_USE, Use.DRIVERS, Use.DRIVERS, Use.NO_USE]
    assert [lane.width_m for lane in crossing.edges["e0f"].lanes] == [2, 0.3, 3.5, 3.5, 1]
    assert len(crossing.edges["e0f"].driven) == 2


def test_widths_are_counted_from_the_middle_to_the_kerb(crossing):
    assert np.isclose(crossing.edges["e0f"].half_m, 8.3)
    assert np.isclose(crossing.edges["e1f"].half_m, 5.2)
    np.testing.assert_allclose(crossing.edges["e0f"].kerb()[:, 1], -8.3)
    np.testing.assert_allclose(crossing.edges["e0f"].middle()[:, 1], 0.0, atol=1e-9)


def test_ways_across_lead_from_the_end_of_a_lane_to_the_start_of_another(crossing):
    assert len(crossing.connectors) == 14
    for way in crossing.connectors:
        start, end = crossing.lanes[way.start], crossing.lanes[way.end]
        np.testing.assert_allclose(way.xy_m[0], start.xy_m[-1], atol=0.02)
        np.testing.assert_allclose(way.xy_m[-1], end.xy_m[0], atol=0.02)


def test_from_each_arm_one_may_go_straight_on_and_turn_both_ways(crossing):
    turns = {edge: set() for edge in ("e0b", "e1b", "e2b", "e3b")}
    for way in crossing.connectors:
        turns[crossing.edge_of[way.start].name].add(way.turn)

    assert all(found == {"s", "l", "r"} for found in turns.values())


def test_a_light_never_lets_crossing_streets_go_at_once(crossing):
    (plan,) = crossing.signals.values()
    straight = {
        crossing.edge_of[way.start].name: way.index
        for way in crossing.connectors
        if way.turn == "s"
    }
    for time_s in np.arange(0.0, plan.ends_s[-1], 0.5):
        letters = plan.shown(float(time_s))
        both = [letters[straight[edge]] in "Gg" for edge in ("e0b", "e1b")]
        assert not all(both)


def test_a_plan_begins_anew_when_it_is_over(crossing):
    (plan,) = crossing.signals.values()

    assert plan.shown(1.0) == plan.shown(1.0 + plan.ends_s[-1])
    assert plan.shown(float(plan.ends_s[0]) - 0.01) == plan.states[0]
    assert plan.shown(float(plan.ends_s[0])) == plan.states[1]


def test_streets_end_where_they_lead_out_of_town(crossing):
    assert crossing.ends == {"n1", "n2", "n3", "n4"}
