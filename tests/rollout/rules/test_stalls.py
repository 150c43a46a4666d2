"""Who has stood for too long: cars on a lane along +x, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from infgen.model.features.signals import StopLines
from infgen.rollout.recording import NO_AGENT
from infgen.rollout.rules.stalls import AWAY_M, IN_LANE_M, WAITS_M, StallRule
from infgen.rollout.session import Session
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import Presence, SignalClass
from infgen.tokens.signals import REMEMBERED
from tests.model.features.test_signals import roads
from tests.rollout.rules.test_collision import everyone
from tests.rollout.rules.test_off_road import street
from tests.rollout.single_rules import only

CAR, WALKER, RIDER = AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST
LONG = 4
"""Token steps that are long enough."""
NO_LINES = StopLines.of(roads([(0, 0, 0)], [0], [[0]]))


def stall_rule(lines=NO_LINES):
    return StallRule([street()], np.zeros(1, dtype=np.int64), lines, LONG)


def ask(remembers, population, tokens):
    """Ask token step by token step; nobody moves meanwhile."""
    return [remembers.stalled(population, token).tolist()[0] for token in tokens]


def stalls(pose, agent_type=CAR, lines=NO_LINES, token=LONG):
    population = everyone(pose, agent_type=agent_type)
    return ask(stall_rule(lines), population, range(token + 1))[-1][0]


def test_who_stands_in_a_lane_stalls_after_so_many_half_seconds():
    found = ask(stall_rule(), everyone((0, 0, 0), (20, 1.5, 0)), range(LONG + 3))

    assert found == [[False, False]] * LONG + [[True, True]] * 3


@pytest.mark.parametrize(
    ("pose", "found"),
    [
        ((0, IN_LANE_M - 0.1, 0.4), True),
        ((0, IN_LANE_M + 0.1, 0), False),  # Parked beside it.
        ((0, 0, np.pi), False),  # Against it.
        ((0, 0, 0.6), False),  # Across.
        ((110, 0, 0), False),  # Beyond its end.
    ],
)
def test_only_in_a_lane_that_leads_its_way(pose, found):
    assert stalls(pose) is found


@pytest.mark.parametrize("agent_type", [WALKER, RIDER])
def test_only_vehicles_do(agent_type):
    assert not stalls((0, 0, 0), agent_type)


def test_who_only_trembled_has_stood_and_who_got_farther_has_not():
    remembers = stall_rule()
    for token in range(LONG):
        shift_m = 0.9 * AWAY_M * (token % 2)
        remembers.stalled(everyone((shift_m, 0, 0), (20 + 0.3 * token, 0, 0)), token)

    last = remembers.stalled(everyone((0, 0, 0), (20 + 0.3 * LONG, 0, 0)), LONG)

    assert last.tolist() == [[True, False]]


def test_who_has_taken_the_place_of_another_begins_anew():
    remembers, first = stall_rule(), everyone((0, 0, 0), (20, 0, 0))
    ask(remembers, first, range(LONG))
    agent_number = np.array([[0, 1]], dtype=np.int32)

    assert ask(remembers, replace(first, agent_number=agent_number), [LONG]) == [
        [True, False]
    ]


def test_who_leaves_and_who_is_not_there_do_not():
    absent = everyone((0, 0, 0), (20, 0, 0))
    absent.agent_number[0, 0], absent.presence[0, 1] = NO_AGENT, Presence.REMOVED

    assert ask(stall_rule(), absent, range(LONG + 1))[-1] == [False, False]


@pytest.mark.parametrize(
    ("shown", "ahead_m", "found"),
    [
        (SignalClass.STOP, 5.0, False),
        (SignalClass.CAUTION, 5.0, False),
        (SignalClass.STOP + REMEMBERED, 5.0, False),
        (SignalClass.GO, 5.0, True),
        (SignalClass.UNKNOWN, 5.0, True),
        (SignalClass.STOP, WAITS_M + 1, True),
    ],
)
def test_who_waits_for_a_light_does_not(shown, ahead_m, found):
    lines = StopLines.of(roads([(ahead_m, 0, 0)], [1], [[shown]]))

    assert stalls((0, 0, 0), lines=lines) is found


def test_who_waited_stalls_when_it_turns_green():
    turns = [[SignalClass.STOP] * (LONG + 2) + [SignalClass.GO] * 2]
    lines = StopLines.of(roads([(5, 0, 0)], [1], turns))

    found = ask(stall_rule(lines), everyone((0, 0, 0)), range(LONG + 4))

    assert found == [[False]] * (LONG + 2) + [[True]] * 2


def stood(playing, begin, tokens):
    """Count vehicles that end where they began."""
    session = Session(playing, begin)
    first = session.population.pose[..., :2]
    for _ in range(tokens):
        session.step()
    way_m = np.linalg.norm(session.population.pose[..., :2] - first, axis=-1)
    return int((way_m < AWAY_M).sum())


def never_sets_off(simulator, metre_moves, **settings):
    """An untrained network to which all but standing is next to impossible."""
    playing = simulator(
        insert=False, remove=False, motion_top_k=0, max_agents=1, **settings
    )
    step, standing = playing.stepper.motion_step, playing.tensor(metre_moves.stationary)

    def still(memory, token_step, rows):
        said = step(memory, token_step, rows)
        agent_type = said.packed.rows.pack(token_step.agent_type.long())
        said.packed.motion_logits[:] += 50.0 * standing[agent_type]
        return said

    playing.stepper.motion_step = still
    return playing


def test_in_rollouts_who_has_stood_too_long_sets_off(drive, start, simulator, metre_moves):
    begin = [start(drive(), at) for at in range(8)]

    for_good, patient, careful = (
        never_sets_off(
            simulator, metre_moves, **only(max_motion_samples=8, max_stall_s=stall_s)
        )
        for stall_s in (0.0, 1.5, 9.0)
    )

    assert stood(for_good, begin, 8) == 8
    assert stood(patient, begin, 8) < 4
    assert stood(careful, begin, 8) == 8
