"""Who sets out and where to."""

from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pytest

from infgen.scene import AgentType
from infgen.sources.towns.road_users import (
    BodyType,
    draw_hesitation,
    draw_motorist,
    draw_size,
)
from infgen.sources.towns.traffic.demand import (
    NUM_WANDERERS,
    Level,
    draw_level,
    draw_trips,
    write_routes,
)
from infgen.sources.towns.traffic.trips import Ways, find_walks, find_ways

LEVEL = Level(cars_per_km=20.0, cars_per_hour=600.0, cyclists=20.0, walkers_per_km=20.0)


@pytest.fixture
def ring():
    """Two edges in a ring, with one way in and one way out."""
    return Ways(
        follows={
            "in": (("a",), (1.0,)),
            "a": (("b", "out"), (1.0, 1.0)),
            "b": (("a",), (1.0,)),
            "out": ((), ()),
        },
        length_m=dict.fromkeys(("in", "a", "b", "out"), 100.0),
        busy=dict.fromkeys(("in", "a", "b", "out"), 1.0),
        sources=("in",),
        exits=frozenset({"out"}),
    )


def test_who_may_leave_ends_at_an_exit(ring):
    route = ring.walk("in", 1e6, np.random.default_rng(0))

    assert route[0] == "in"
    assert route[-1] == "out"


def test_who_may_not_leave_walks_on_until_the_way_is_long_enough(ring):
    route = ring.walk("a", 1000.0, np.random.default_rng(0), leave=False)

    assert route == ["a", "b"] * 5


def test_ways_follow_the_connectors(crossing):
    ways = find_ways(crossing, cycling=False)

    assert set(ways.sources) == {"e0b", "e1b", "e2b", "e3b"}
    assert ways.exits == {"e0f", "e1f", "e2f", "e3f"}
    assert set(ways.follows["e0b"][0]) == {"e1f", "e2f", "e3f"}
    # Two lanes of an arterial against one of a local street.
    assert ways.busy["e0f"] / ways.busy["e1f"] == pytest.approx(2 * 2.2 / 0.25)


def test_walks_go_from_pavement_to_pavement(crossing):
    walks = find_walks(crossing, 50, 400.0, np.random.default_rng(0))

    assert len(walks) == 50
    for walk in walks:
        assert len(set(walk)) == len(walk)
        for one, other in pairwise(walk):
            ends = [{crossing.edges[e].start, crossing.edges[e].end} for e in (one, other)]
            assert ends[0] & ends[1]


def test_all_kinds_set_out_by_their_time(town_trips):
    kinds = {trip.person.body.kind for trip in town_trips}
    departs_s = [trip.depart_s for trip in town_trips]

    assert kinds == {AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST}
    assert departs_s == sorted(departs_s)
    assert max(departs_s) < 120.0


def test_nobody_begins_where_no_way_leads_on(town_trips):
    for trip in town_trips:
        if trip.person.body is not BodyType.WALKER:
            assert len(trip.route) >= 2


@pytest.fixture(scope="module")
def town_trips(crossing_with_middle):
    return draw_trips(crossing_with_middle, LEVEL, 120.0, np.random.default_rng(0))


@pytest.fixture(scope="module")
def crossing_with_middle(crossing):
    """The crossing, with nobody's street leading out of town: wanderers need some."""
    rules = {name: "priority" for name in crossing.rules} | {"n1": "dead_end"}
    return type(crossing)(
        crossing.edges,
        crossing.connectors,
        crossing.crossings,
        crossing.signals,
        rules,
        crossing.places_m,
    )


def test_routes_are_written_one_for_each_trip(town_trips, tmp_path):
    path = tmp_path / "town.rou.xml"
    write_routes(town_trips, path)
    root = ElementTree.parse(path).getroot()

    names = [each.attrib["id"] for each in root if each.tag in ("vehicle", "person")]
    assert names == [str(at) for at in range(len(town_trips))]
    assert len(root.findall("vType")) == len(town_trips)
    assert len(root.findall("person")) > 0


def test_some_cars_never_leave(town_trips):
    staying = [trip for trip in town_trips if trip.depart_s == 0 and trip.anywhere]

    assert len(staying) >= NUM_WANDERERS


def test_towns_are_from_nearly_empty_to_dense():
    levels = [draw_level(np.random.default_rng(seed)).cars_per_km for seed in range(200)]

    assert max(levels) / min(levels) > 4


def test_boxes_are_of_a_size_that_sumo_reads_back():
    for body in BodyType:
        size_m = np.array([draw_size(body, np.random.default_rng(s)) for s in range(50)])
        np.testing.assert_array_equal(size_m, np.round(size_m, 3))
        assert size_m.min() > 0.5


def test_most_motorists_drive_cars():
    bodies = [draw_motorist(np.random.default_rng(seed)).body for seed in range(300)]

    assert 0.8 < bodies.count(BodyType.CAR) / 300 < 0.95


def test_half_of_drivers_take_more_than_a_moment_to_set_off():
    hesitation_s = [draw_hesitation(np.random.default_rng(seed)) for seed in range(400)]

    assert np.median(hesitation_s) == pytest.approx(0.7, abs=0.1)
    assert min(hesitation_s) > 0
    assert max(hesitation_s) <= 2.5
