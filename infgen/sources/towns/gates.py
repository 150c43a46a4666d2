"""Who may cross: lights, stop signs, and giving way to those who go first.

Before a gated strip a user must hold a claim on it. A claim is given when the light allows
it, one has stood at the sign, no strip that crosses it is claimed, and nobody of lower rank
is about to claim such a strip. It is held until the user's rear has left the strip.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from infgen.scene import AgentKind, SignalState
from infgen.sources.towns.routes import Routes
from infgen.sources.towns.town import NO_GROUP, Gate, Town

SIGHT_M = 70.0
"""Users farther from their gate concern nobody."""
ARRIVAL_S = 4.5
"""Users who would reach their gate within it are about to claim it."""
STAND_STEPS = 6
"""How long one stands at a stop sign, in steps."""
CLAIM_MPS2 = 2.0
"""A claim is made while one could still brake this gently instead."""
STOPPING_MPS2 = 3.0
"""A light that warns is heeded by those who need not brake harder."""
OVERSHOOT_M = 1.0
NO_CLAIM = -1


@dataclass(frozen=True, slots=True)
class Positions:
    """Where the users under way are: rows of users, and one value for each of them."""

    user: Int64[np.ndarray, " here"]
    kind: Int64[np.ndarray, " here"]
    route: Int64[np.ndarray, " here"]
    front_m: Float64[np.ndarray, " here"]
    rear_m: Float64[np.ndarray, " here"]
    speed_mps: Float64[np.ndarray, " here"]


@dataclass(frozen=True, slots=True)
class _Queue:
    """The users who are next at their gates, in the order in which they are served.

    Attributes:
        at: Position in ``Positions``.
        strip: What they want to claim.
        gate_m: How far their front is from it.
        rank: Of the gate.
        willing: Whether the light and the sign allow them to go.
    """

    at: Int64[np.ndarray, " next"]
    strip: Int64[np.ndarray, " next"]
    gate_m: Float64[np.ndarray, " next"]
    rank: Int64[np.ndarray, " next"]
    willing: Bool[np.ndarray, " next"]


class Gates:
    """The claims of all users."""

    def __init__(self, town: Town, routes: Routes, num_users: int) -> None:
        self.town, self.routes = town, routes
        self.claim = np.full(num_users, NO_CLAIM)
        self.stood = np.zeros(num_users, np.int64)
        no_gate = Gate(rank=0)
        gates = [strip.gate or no_gate for strip in town.strips]
        self.rank = np.array([gate.rank for gate in gates])
        self.stop = np.array([gate.stop for gate in gates])
        self.group = np.array([gate.group for gate in gates])

    def distance_m(self, here: Positions) -> Float64[np.ndarray, " here"]:
        """Distance of each front from a gate closed to it; infinite if there is none."""
        strip, gate_m = self._next(here)
        return np.where(self.claim[here.user] == strip, np.inf, gate_m)

    def decide(self, here: Positions, time_s: float) -> None:
        """Take back what is no longer used, and give claims to those who may go."""
        opened = self._open(time_s)
        self._release(here, opened)
        queue = self._line_up(here, opened)
        about = self._about_to_go(here, queue)
        near = queue.gate_m < self._claim_m(here)[queue.at]
        for row in np.flatnonzero(queue.willing & near):
            strip = queue.strip[row]
            held = self.claim[here.user]
            crossing = self.town.conflicts[strip]
            if crossing[held[held != NO_CLAIM]].any():
                continue
            first = about & (queue.rank < queue.rank[row]) & crossing[queue.strip]
            if not first.any():
                self.claim[here.user[queue.at[row]]] = strip

    def _next(self, here: Positions) -> tuple[np.ndarray, np.ndarray]:
        """Next gated strip of each user (-1: none) and the way to it."""
        # Who stops a little past the line has not passed it.
        row = self.routes.row(here.route, here.front_m - OVERSHOOT_M)
        return self.routes.gate[row], self.routes.gate_m[row] - here.front_m

    def _claim_m(self, here: Positions) -> Float64[np.ndarray, " here"]:
        walking = here.kind == AgentKind.PEDESTRIAN
        return np.where(walking, 1.2, here.speed_mps**2 / (2 * CLAIM_MPS2) + 5.0)

    def _open(self, time_s: float) -> Int64[np.ndarray, " strip"]:
        """What the light of every strip says: ``SignalState.GO`` where there is none."""
        shown = np.full(len(self.group), SignalState.GO, np.int64)
        if self.town.plan is None:
            return shown
        for row in np.flatnonzero(self.group != NO_GROUP):
            group = int(self.group[row])
            if self.town.strips[row].kind == AgentKind.PEDESTRIAN:
                walk = self.town.plan.walk(group, time_s)
                shown[row] = SignalState.GO if walk else SignalState.STOP
            else:
                shown[row] = self.town.plan.state(group, time_s)
        return shown

    def _release(self, here: Positions, opened: Int64[np.ndarray, " strip"]) -> None:
        claim = self.claim[here.user]
        known = claim != NO_CLAIM
        strip = np.where(known, claim, 0)
        passed = here.rear_m > self.routes.end_m[here.route, strip]
        before_m = self.routes.start_m[here.route, strip] - here.front_m
        stopping_m = here.speed_mps**2 / (2 * STOPPING_MPS2) + 1.0
        turned = (opened[strip] != SignalState.GO) & (before_m > stopping_m)
        driving = here.kind != AgentKind.PEDESTRIAN
        dropped = known & (passed | (turned & driving))
        self.claim[here.user[dropped]] = NO_CLAIM

    def _line_up(self, here: Positions, opened: Int64[np.ndarray, " strip"]) -> _Queue:
        strip, gate_m = self._next(here)
        wanting = (strip >= 0) & (self.claim[here.user] != strip) & (gate_m < SIGHT_M)
        standing = wanting & (gate_m < 3.5) & (here.speed_mps < 0.3)
        self.stood[here.user] = np.where(standing, self.stood[here.user] + 1, 0)
        wanting &= self._foremost(here, wanting, gate_m)
        strip = np.where(wanting, strip, 0)
        stopping_m = here.speed_mps**2 / (2 * STOPPING_MPS2)
        cannot_stop = (opened[strip] == SignalState.CAUTION) & (gate_m < stopping_m)
        willing = (opened[strip] == SignalState.GO) | cannot_stop
        stood = self.stood[here.user]
        willing &= ~self.stop[strip] | (stood >= STAND_STEPS)
        at = np.flatnonzero(wanting)
        at = at[np.lexsort((here.user[at], gate_m[at], -stood[at], self.rank[strip[at]]))]
        return _Queue(at, strip[at], gate_m[at], self.rank[strip[at]], willing[at])

    def _foremost(
        self,
        here: Positions,
        wanting: Bool[np.ndarray, " here"],
        gate_m: Float64[np.ndarray, " here"],
    ) -> Bool[np.ndarray, " here"]:
        """Whether nobody without a claim is ahead on the strip. Walkers stand abreast."""
        row = self.routes.row(here.route, here.front_m - OVERSHOOT_M)
        strip = self.routes.strip[row]
        order = np.lexsort((here.user, gate_m, strip, ~wanting))
        first = np.ones(len(order), bool)
        first[1:] = strip[order][1:] != strip[order][:-1]
        foremost = np.empty(len(order), bool)
        foremost[order] = first
        return foremost | (here.kind == AgentKind.PEDESTRIAN)

    def _about_to_go(self, here: Positions, queue: _Queue) -> Bool[np.ndarray, " next"]:
        walking = here.kind[queue.at] == AgentKind.PEDESTRIAN
        arrival_s = queue.gate_m / np.maximum(here.speed_mps[queue.at], 2.0)
        near = np.where(walking, queue.gate_m < 2.0, arrival_s < ARRIVAL_S)
        return queue.willing & near
