"""Where people walk: pavements along the kerbs, and crosswalks at the mouths of arms."""

import numpy as np

from infgen.scene import AgentKind
from infgen.sources.towns.arms import CROSSWALK_M, Arm
from infgen.sources.towns.curves import Points
from infgen.sources.towns.streets import Control, Draft, around_corner
from infgen.sources.towns.town import NO_GROUP, Gate

WALK_WIDTH_M = 1.0
CROSSING_WIDTH_M = 2.0
WALK_LIMIT_MPS = 2.2
WALKERS_FIRST = 0
"""Rank of walkers' gates: nobody makes them wait but a light."""

_CROSSING_M = sum(CROSSWALK_M) / 2
_LEFT, _RIGHT = 1, -1


def draw_pavements(draft: Draft) -> None:
    """Add the ways along arms, around corners and across crosswalks, both directions."""
    for at, arm in enumerate(draft.arms):
        for side in (_LEFT, _RIGHT):
            out_m = arm.outward(side * arm.walk_m, _CROSSING_M)
            _walk(draft, ("walk in", at, side), out_m[::-1])
            _walk(draft, ("walk out", at, side), out_m)
        following = (at + 1) % len(draft.arms)
        corner_m = around_corner(arm, draft.arms[following], arm.walk_m, _CROSSING_M)
        _walk(draft, ("corner", at, _LEFT), corner_m)
        _walk(draft, ("corner", at, _RIGHT), corner_m[::-1])
        if arm.crosswalk:
            _crossing(draft, at, arm)
    for at in range(len(draft.arms)):
        _lead(draft, at)


def crosswalks(arms: tuple[Arm, ...]) -> tuple[Points, ...]:
    """Outlines of the crosswalks."""
    return tuple(arm.across(*CROSSWALK_M) for arm in arms if arm.crosswalk)


def _walk(draft: Draft, key: tuple[str, int, int], xy_m: Points) -> None:
    draft.add(
        key,
        xy_m,
        kind=AgentKind.PEDESTRIAN,
        width_m=WALK_WIDTH_M,
        limit_mps=WALK_LIMIT_MPS,
    )


def _crossing(draft: Draft, at: int, arm: Arm) -> None:
    ends = [
        arm.outward(side * arm.walk_m, _CROSSING_M, 10.0)[0] for side in (_LEFT, _RIGHT)
    ]
    # Walkers go with the traffic beside them, which is the other group's.
    group = 1 - at % 2 if draft.control is Control.SIGNALS else NO_GROUP
    for side, xy_m in ((_LEFT, np.array(ends)), (_RIGHT, np.array(ends[::-1]))):
        draft.add(
            ("cross", at, side),
            xy_m,
            kind=AgentKind.PEDESTRIAN,
            width_m=CROSSING_WIDTH_M,
            limit_mps=WALK_LIMIT_MPS,
            gate=Gate(WALKERS_FIRST, group=group),
        )


def _lead(draft: Draft, at: int) -> None:
    """Say where one can go on from both sides of one arm's mouth."""
    num_arms = len(draft.arms)
    for side in (_LEFT, _RIGHT):
        corner = ("corner", at if side == _LEFT else (at - 1) % num_arms, side)
        arriving = ("corner", corner[1], -side)
        crossing = [("cross", at, side)] if draft.arms[at].crosswalk else []
        for key in [corner, *crossing]:
            draft.lead(("walk in", at, side), key)
        for key in [("walk out", at, side), *crossing]:
            draft.lead(arriving, key)
        if draft.arms[at].crosswalk:
            for key in [("walk out", at, side), corner]:
                draft.lead(("cross", at, -side), key)
