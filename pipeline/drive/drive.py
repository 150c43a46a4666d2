"""One drive through one scene, tick by tick.

Two clocks meet here. The car moves every tick (0.025 s), so that keys act at once; the
world moves in token steps of 0.5 s. ``LEAD_TICKS`` before one is over, its end and the
beginning of the next one are requested and computed meanwhile, with the controls held as
they are at that moment: other agents react to what the ego did up to ``LEAD_TICKS`` before
their token step begins. Where the driver then does otherwise, the network sees it at the
end of the next token step.

What comes out depends on the controls at each tick only, never on how fast anything was:
where the world is late, the clock waits.
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from infgen.clock import CLOCK
from infgen.geometry import wrap_angle
from infgen.rollout.population import EGO_ROW
from infgen.rollout.recording import Frame
from pipeline.drive.car import (
    RELEASED,
    TICKS_PER_STEP,
    TICKS_PER_TOKEN,
    Car,
    Controls,
)
from pipeline.drive.world import World, WorldStep

LEAD_TICKS = 12
"""A token step is asked for 0.3 s before it is shown."""
TIMED_STEPS = 240
"""Token steps whose times are kept: two minutes."""
MAX_RECORDED_S = 600.0
"""A recording ends here: memory stays bounded however long one drives."""

Submit = Callable[[Callable[[], WorldStep]], "Future[WorldStep]"]
"""Starts some work elsewhere."""


@dataclass(frozen=True, slots=True)
class Moment:
    """The ego after one tick.

    Attributes:
        step: Time in steps of the scene.
        pose: x, y, heading.
        rate: Change of the pose in a second.
        speed_mps: Negative backwards.
    """

    step: float
    pose: Float32[np.ndarray, "3"]
    rate: Float32[np.ndarray, "3"]
    speed_mps: float


class Drive:
    """The ego, the token step that is shown, and the next one.

    Attributes:
        world: Everyone else.
        shown: The token step that is shown.
        car: The driven car; None while the network drives.
        at_wheel: Whether a person is to drive.
        late_ticks: Ticks that the clock has waited for the world.
        inserted: Agents that have entered so far.
        removed: Agents that have left.
        frames: What has been driven, up to ``MAX_RECORDED_S``.
        step_s: Seconds of the last world steps.
    """

    def __init__(self, world: World, submit: Submit) -> None:
        """Simulate the first token step, the network driving."""
        self.world, self._submit = world, submit
        self.at_wheel, self.late_ticks, self.inserted, self.removed = False, 0, 0, 0
        self.car: Car | None = None
        self.frames: list[Frame] = []
        self.step_s: deque[float] = deque(maxlen=TIMED_STEPS)
        self._step = float(world.start.scene.now)
        self._begin, self._speed_mps = world.ego_pose, world.ego_speed_mps
        self._next: Future[WorldStep] | None = None
        self._show(world.step())

    def tick(self, controls: Controls = RELEASED) -> Moment | None:
        """Drive one tick; None if the clock waits for the world."""
        if self._tick == TICKS_PER_TOKEN:
            if self._next is None or not self._next.done():
                self.late_ticks += 1
                return None
            coming = self._next.result()
            self._record(coming)
            self._begin = self._path[-1].copy()
            self._show(coming)
        before = self._pose
        self._tick += 1
        self._step = self._first_step + self._tick / TICKS_PER_STEP
        self._move(controls)
        if self._tick == TICKS_PER_TOKEN - LEAD_TICKS:
            self._ask(controls)
        return self._moment(before)

    @property
    def coming(self) -> WorldStep | None:
        """The next token step, once it is there."""
        return self._next.result() if self._next is not None and self._next.done() else None

    @property
    def seconds(self) -> float:
        """How long the drive has gone on."""
        return (self._step - self.world.start.scene.now) * CLOCK.step_s

    @property
    def recorded_s(self) -> float:
        """How much of it can be saved."""
        return len(self.frames) * CLOCK.token_s

    def take_wheel(self) -> None:
        """Let a person drive, from where the ego is now."""
        self.at_wheel = True
        if self.car is None:
            length_m = self.world.ego_length_m
            self.car = Car.at(self._pose, max(0.0, self._speed_mps), length_m)

    def hand_back(self) -> None:
        """Let the network drive again, from the next token step it is asked for."""
        self.at_wheel = False

    def shift(self) -> None:
        """Shift between forward and reverse."""
        if self.car is not None:
            self.car = self.car.shift()

    def _show(self, step: WorldStep) -> None:
        """Begin the next token step."""
        self.shown, self._next, self._tick = step, None, 0
        self._first_step = CLOCK.start_step(step.token)
        self._path = step.path[EGO_ROW].copy()
        self._pose = self._begin.copy()
        self._steered = step.driven
        self.inserted += step.num_inserted
        self.removed += int(step.removed.sum())
        self.step_s.append(step.seconds)
        if not step.driven and not self.at_wheel:
            self.car = None

    def _move(self, controls: Controls) -> None:
        """Move the ego: as it is driven, or along the network's path."""
        if self.car is None:
            self._pose = _along(self._begin, self._path, self._tick)
            return
        self._steered = True
        self.car = self.car.drive(controls)
        self._pose = self.car.pose
        if self._tick % TICKS_PER_STEP == 0:
            self._path[self._tick // TICKS_PER_STEP - 1] = self._pose

    def _ask(self, controls: Controls) -> None:
        """Ask for the next token step, with controls held until its end."""
        car, world = self.car, self.world
        if car is None:
            self._next = self._submit(world.step)
            return
        driven = self._path.copy()
        for tick in range(self._tick + 1, TICKS_PER_TOKEN + 1):
            car = car.drive(controls)
            if tick % TICKS_PER_STEP == 0:
                driven[tick // TICKS_PER_STEP - 1] = car.pose
        plan = car.drive_token(controls) if self.at_wheel else None
        self._next = self._submit(lambda: world.step(driven, plan))

    def _record(self, coming: WorldStep) -> None:
        """Keep the token step that is over, the ego where it was driven to its end."""
        frame = coming.ended
        assert frame is not None  # Only the first token step comes after none.
        if self.recorded_s >= MAX_RECORDED_S:
            return
        if self._steered:
            path = frame.path.copy()
            path[0, EGO_ROW] = self._path
            frame = replace(frame, path=path)
        self.frames.append(frame)

    def _moment(self, before: Float32[np.ndarray, "3"]) -> Moment:
        rate = self._pose - before
        rate[2] = wrap_angle(rate[2:])[0]
        rate *= np.float32(TICKS_PER_STEP / CLOCK.step_s)
        heading = self._pose[2]
        ahead = float(rate[0] * np.cos(heading) + rate[1] * np.sin(heading))
        self._speed_mps = self.car.speed_mps if self.car else ahead
        return Moment(self._step, self._pose, rate, self._speed_mps)


def _along(
    begin: Float32[np.ndarray, "3"], path: Float32[np.ndarray, "5 3"], tick: int
) -> Float32[np.ndarray, "3"]:
    """Return the pose after so many ticks on a path, straight between its steps."""
    number, part = divmod(tick, TICKS_PER_STEP)
    start = begin if number == 0 else path[number - 1]
    if part == 0:
        return start.copy()
    way = path[number] - start
    way[2:] = wrap_angle(way[2:])
    pose = start + np.float32(part / TICKS_PER_STEP) * way
    pose[2:] = wrap_angle(pose[2:])
    return pose
