"""Drivers who do not look ahead for a while, so that logs show how one recovers from it.

Drivers of towns look ahead at all times. So no log shows a vehicle that is too fast behind
another one, and a network that learns from logs alone does not know what to do when it is.
Here the expert is disturbed before a recording begins, and what it does next is recorded,
as in DART (Laskey et al. 2017): some drivers hold a speed of their own, whatever stands
ahead, and look up in time to brake for it, but only just.

SUMO runs in this process for it (``libsumo``), one simulation at a time.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from infgen.sources.towns.variety import Inattention

if TYPE_CHECKING:
    from types import ModuleType

BLIND_MODE, LOOKING_MODE = 0b00110, 0b11111
"""SUMO's speed modes: within what the vehicle can do, and with regard to all others."""
STANDING_MPS = 0.5
STANDING_SHARE = 0.4
"""Of those drawn who stand, so many begin to move; the others go on standing."""
START_MPS = (1.5, 4.0)
"""How fast one gets who begins to move ..."""
HELD_SHARE, FASTER_MPS = (0.95, 1.15), (0.0, 1.5)
"""... and how fast who drives: a share of the speed, and a little more."""
LOOK_AHEAD_M = 60.0
LEAST_GAP_M = 0.8
"""One looks up when the gap ahead gets so small."""
MUST_YIELD_SHARE = 0.5
"""So many look up for who has the right of way, too."""
_LEAST_MPS, _LEAST_M = 0.1, 0.1


@dataclass(frozen=True, slots=True)
class _Unaware:
    """A driver who does not look ahead.

    Attributes:
        until: Step at which they look again at the latest.
        brake_mps2: They look up in time to brake so hard.
        yields: Whether they look up for who has the right of way.
    """

    until: int
    brake_mps2: float
    yields: bool


class InattentiveDrivers:
    """Who looks ahead and who does not, in the simulation that SUMO runs in this process.

    Attributes:
        planned: Steps from which, and until which, drivers will not look, by name.
        unaware: Who does not look, by name.
    """

    def __init__(
        self, sumo: "ModuleType", inattention: Inattention, first: int, seed: int
    ) -> None:
        """Watch a simulation.

        Args:
            sumo: ``libsumo``, its simulation loaded.
            inattention: Who does not look, and when.
            first: Step at which a recording may begin, and from there on every period.
            seed: Of all that is drawn.
        """
        self._sumo, self._about, self._first = sumo, inattention, first
        self._rng = np.random.default_rng(seed)
        self.planned: dict[str, tuple[int, int]] = {}
        self.unaware: dict[str, _Unaware] = {}

    def before_step(self, step: int) -> None:
        """Let drivers look away, and look again, before SUMO makes a step."""
        since = step - self._first + self._about.before_steps
        if since >= 0 and since % self._about.period_steps == 0:
            self._draw(step)
        if not self.planned and not self.unaware:
            return
        there = set(self._sumo.vehicle.getIDList())
        for name, (begin, until) in list(self.planned.items()):
            if begin == step or name not in there:
                del self.planned[name]
                if name in there:
                    self._look_away(name, until)
        for name, driver in list(self.unaware.items()):
            if name not in there:
                del self.unaware[name]
            elif step >= driver.until or self._needs_brakes(name, driver):
                del self.unaware[name]
                self._sumo.vehicle.setSpeed(name, -1)
                self._sumo.vehicle.setSpeedMode(name, LOOKING_MODE)

    def _draw(self, step: int) -> None:
        """Draw who will not look, from when, and for how long."""
        about, rng = self._about, self._rng
        shortest, longest = about.steps
        last = about.before_steps + about.until_steps
        for name in self._sumo.vehicle.getIDList():
            if rng.random() < about.share:
                begin = int(rng.integers(0, last - shortest))
                until = begin + int(rng.integers(shortest, longest + 1))
                self.planned[name] = step + begin, step + min(until, last)

    def _look_away(self, name: str, until: int) -> None:
        vehicle, rng = self._sumo.vehicle, self._rng
        speed_mps = vehicle.getSpeed(name)
        if speed_mps < STANDING_MPS:
            if rng.random() >= STANDING_SHARE:
                return
            held_mps = rng.uniform(*START_MPS)
        else:
            held_mps = speed_mps * rng.uniform(*HELD_SHARE) + rng.uniform(*FASTER_MPS)
        brake_mps2 = float(rng.uniform(*self._about.brake_mps2))
        yields = bool(rng.random() < MUST_YIELD_SHARE)
        self.unaware[name] = _Unaware(until, brake_mps2, yields)
        vehicle.setSpeedMode(name, BLIND_MODE)
        vehicle.setSpeed(name, held_mps)

    def _needs_brakes(self, name: str, driver: _Unaware) -> bool:
        """Whether it takes the brakes by now: for who is ahead, a light, or to yield."""
        vehicle = self._sumo.vehicle
        speed_mps = max(vehicle.getSpeed(name), _LEAST_MPS)

        def is_late(closing_mps: float, gap_m: float) -> bool:
            closing_mps = max(closing_mps, 0.0)
            return closing_mps**2 / 2 / max(gap_m, _LEAST_M) > driver.brake_mps2

        leader, gap_m = vehicle.getLeader(name, LOOK_AHEAD_M) or ("", 0.0)
        if leader and (
            gap_m < LEAST_GAP_M or is_late(speed_mps - vehicle.getSpeed(leader), gap_m)
        ):
            return True
        lights = vehicle.getNextTLS(name)
        if lights:
            _, _, left_m, state = lights[0]
            if state in "ryY" and is_late(speed_mps, left_m):
                return True
        links = vehicle.getNextLinks(name) if driver.yields else ()
        if not links or links[0][2]:  # The next one is open.
            return False
        lane_m = self._sumo.lane.getLength(vehicle.getLaneID(name))
        return is_late(speed_mps, lane_m - vehicle.getLanePosition(name))
