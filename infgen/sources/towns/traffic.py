"""Traffic: everyone follows a route, keeps a distance and waits where they must.

Speeds follow the Intelligent Driver Model (Treiber et al., 2000, arXiv:cond-mat/0002177),
with a limit on how fast the acceleration may change. Who may cross is decided in ``gates``.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from infgen.clock import CLOCK
from infgen.scene import AgentKind
from infgen.sources.towns.demand import Users
from infgen.sources.towns.gates import Gates, Positions
from infgen.sources.towns.routes import Routes
from infgen.sources.towns.town import Town

BRAKING_MPS2 = 2.0
HARDEST_MPS2 = 6.5
JERK_MPS3 = (6.0, 14.0)
"""How fast the acceleration may rise and fall."""
STANDING_GAP_M = {AgentKind.VEHICLE: 1.8, AgentKind.PEDESTRIAN: 0.4, AgentKind.CYCLIST: 1.0}
SHORT_OF_LINE_M = 0.6
"""Where one stands before a closed gate."""
TAIL_M = 7.0
"""Someone who turns off still blocks those who go on until so far behind is clear."""
CHANGE_S = 4.0
"""How long a change of lane takes."""
_RARE = 0.01


@dataclass(frozen=True, slots=True)
class Traffic:
    """Where everyone was.

    Attributes:
        route: Route of each user at each step.
        along_m: Position of the middle of the user on it.
        aside_m: How far left of the route a change of lane has still left them.
        aside_mps: How fast that changes.
        speed_mps: Speed along it.
        present: Whether the user was under way.
    """

    route: Int64[np.ndarray, "user step"]
    along_m: Float64[np.ndarray, "user step"]
    aside_m: Float64[np.ndarray, "user step"]
    aside_mps: Float64[np.ndarray, "user step"]
    speed_mps: Float64[np.ndarray, "user step"]
    present: Bool[np.ndarray, "user step"]


def simulate(
    town: Town, routes: Routes, users: Users, num_steps: int, rng: np.random.Generator
) -> Traffic:
    """Play traffic for so many steps of 0.1 s."""
    crowd = _Crowd(town, routes, users, rng)
    frames = []
    for step in range(num_steps):
        crowd.advance(step * CLOCK.step_s)
        frames.append(crowd.frame())
    columns = [np.stack(column, axis=1) for column in zip(*frames, strict=True)]
    return Traffic(*columns)


class _Crowd:
    """Everyone's state at one moment. Arrays are per user."""

    def __init__(
        self, town: Town, routes: Routes, users: Users, rng: np.random.Generator
    ) -> None:
        self.town, self.routes, self.users, self.rng = town, routes, users, rng
        self.gates = Gates(town, routes, len(users))
        count = len(users)
        self.route = users.route.copy()
        self.along_m = users.start_m.copy()
        self.speed_mps = np.zeros(count)
        self.accel_mps2 = np.zeros(count)
        self.shift_m = np.zeros(count)
        self.since_shift_s = np.full(count, np.inf)
        self.waiting = np.ones(count, bool)
        self.present = np.zeros(count, bool)
        self.standing_m = np.array([STANDING_GAP_M[AgentKind(k)] for k in range(3)])[
            users.kind
        ]

    def frame(self) -> tuple[np.ndarray, ...]:
        """Return the columns of ``Traffic`` at this moment."""
        part = np.clip(self.since_shift_s / CHANGE_S, 0.0, 1.0)
        aside_m = self.shift_m * (1 - part**3 * (10 - 15 * part + 6 * part**2))
        aside_mps = -self.shift_m * 30 * part**2 * (1 - part) ** 2 / CHANGE_S
        state = (self.route, self.along_m, aside_m, aside_mps, self.speed_mps, self.present)
        return tuple(column.copy() for column in state)

    def advance(self, time_s: float) -> None:
        """Move everyone by one step."""
        self._appear(time_s)
        here = np.flatnonzero(self.present)
        ahead_m, ahead_mps = self._leaders(here)
        positions = self._positions(here)
        self.gates.decide(positions, time_s)
        gate_m = self.gates.distance_m(positions)
        self._accelerate(here, ahead_m, ahead_mps, gate_m)
        self._move(here)
        if round(time_s / CLOCK.step_s) % 10 == 0:
            self._change_lanes(here, ahead_m, ahead_mps)

    def _positions(self, here: Int64[np.ndarray, " here"]) -> Positions:
        along_m, half_m = self.along_m[here], self.half_m(here)
        return Positions(
            user=here,
            kind=self.users.kind[here],
            route=self.route[here],
            front_m=along_m + half_m,
            rear_m=along_m - half_m,
            speed_mps=self.speed_mps[here],
        )

    def half_m(self, rows: np.ndarray) -> Float64[np.ndarray, " user"]:
        """Half the length of users."""
        return self.users.size_lwh_m[rows, 0] / 2

    def wished_mps(self, rows: np.ndarray) -> Float64[np.ndarray, " user"]:
        """Speed users would go if they were alone."""
        limit_mps = self.routes.limit_mps[
            self.routes.row(self.route[rows], self.along_m[rows])
        ]
        return limit_mps * self.users.haste[rows]

    def _appear(self, time_s: float) -> None:
        """Let users set out whose time has come and whose place is free."""
        due = np.flatnonzero(self.waiting & (self.users.start_s <= time_s))
        taken = set()
        for user in due.tolist():
            source = self.routes.strips[self.route[user]][0]
            if time_s > 0 and (source in taken or not self._clear(user)):
                taken.add(source)
                continue
            taken.add(source)
            self.waiting[user], self.present[user] = False, True
            self.speed_mps[user] = 0.9 * self.wished_mps(np.array([user]))[0]

    def _clear(self, user: int) -> bool:
        """Whether there is room to set out at cruising speed."""
        here = np.append(np.flatnonzero(self.present), user)
        gap_m, _ = self._leaders(here)
        return bool(gap_m[-1] > 4.0 + 1.5 * self.wished_mps(np.array([user]))[0])

    def _leaders(
        self, here: Int64[np.ndarray, " here"]
    ) -> tuple[Float64[np.ndarray, " here"], Float64[np.ndarray, " here"]]:
        """Gap to, and speed of, whoever is next ahead on each user's own route."""
        half_m = self.half_m(here)
        route, along_m = self.route[here], self.along_m[here]
        rear_m = np.maximum(along_m - half_m - TAIL_M, 0.0)
        apart_m = self._ahead(route, along_m, along_m)
        tail_m = self._ahead(route, rear_m, along_m) + (along_m - rear_m)
        apart_m = np.where(np.isnan(apart_m), tail_m, apart_m)
        np.fill_diagonal(apart_m, np.nan)
        apart_m = np.where(apart_m > 0, apart_m, np.inf) - half_m[:, None] - half_m
        nearest = apart_m.argmin(axis=1) if len(here) else np.zeros(0, np.int64)
        return apart_m[np.arange(len(here)), nearest], self.speed_mps[here][nearest]

    def _ahead(
        self,
        route: Int64[np.ndarray, " here"],
        at_m: Float64[np.ndarray, " here"],
        from_m: Float64[np.ndarray, " here"],
    ) -> Float64[np.ndarray, "here here"]:
        """How far ahead on a row's route a column's point lies; NaN if it is not on it."""
        strip = self.routes.strip[self.routes.row(route, at_m)]
        on_strip_m = at_m - self.routes.start_m[route, strip]
        return self.routes.start_m[route][:, strip] + on_strip_m - from_m[:, None]

    def _accelerate(
        self,
        here: Int64[np.ndarray, " here"],
        ahead_m: Float64[np.ndarray, " here"],
        ahead_mps: Float64[np.ndarray, " here"],
        gate_m: Float64[np.ndarray, " here"],
    ) -> None:
        speed_mps, most = self.speed_mps[here], self.users.accel_mps2[here]
        wished_mps = np.maximum(self.wished_mps(here), 0.1)
        free = most * (1 - (speed_mps / wished_mps) ** 4)
        free = np.where(speed_mps > wished_mps, 1.5 * (wished_mps - speed_mps), free)
        behind = free.clip(-BRAKING_MPS2) - self._push(here, ahead_m, speed_mps - ahead_mps)
        line_m = gate_m + self.standing_m[here] - SHORT_OF_LINE_M
        at_gate = free.clip(-BRAKING_MPS2) - self._push(here, line_m, speed_mps)
        wanted = np.minimum(behind, at_gate).clip(-HARDEST_MPS2, most)
        rise, fall = JERK_MPS3[0] * CLOCK.step_s, JERK_MPS3[1] * CLOCK.step_s
        before = self.accel_mps2[here]
        self.accel_mps2[here] = np.clip(wanted, before - fall, before + rise)

    def _push(
        self,
        here: Int64[np.ndarray, " here"],
        gap_m: Float64[np.ndarray, " here"],
        closing_mps: Float64[np.ndarray, " here"],
    ) -> Float64[np.ndarray, " here"]:
        """How much an obstacle ahead takes from the acceleration."""
        speed_mps, most = self.speed_mps[here], self.users.accel_mps2[here]
        braking_m = speed_mps * closing_mps / (2 * np.sqrt(most * BRAKING_MPS2))
        wanted_m = speed_mps * self.users.headway_s[here] + braking_m
        wanted_m = self.standing_m[here] + np.maximum(wanted_m, 0.0)
        return most * (wanted_m / np.maximum(gap_m, 0.1)) ** 2

    def _move(self, here: Int64[np.ndarray, " here"]) -> None:
        before = self.speed_mps[here]
        after = np.maximum(before + self.accel_mps2[here] * CLOCK.step_s, 0.0)
        after = np.where((after < 0.05) & (self.accel_mps2[here] <= 0), 0.0, after)
        self.accel_mps2[here] = np.where(after > 0, self.accel_mps2[here], 0.0)
        self.speed_mps[here] = after
        self.along_m[here] += (before + after) / 2 * CLOCK.step_s
        self.since_shift_s[here] += CLOCK.step_s
        front_m = self.along_m[here] + self.half_m(here)
        self.present[here] = front_m < self.routes.length_m[self.route[here]] - 0.5

    def _change_lanes(
        self,
        here: Int64[np.ndarray, " here"],
        ahead_m: Float64[np.ndarray, " here"],
        ahead_mps: Float64[np.ndarray, " here"],
    ) -> None:
        """Let those held up, and a few others, move to the lane beside them."""
        held_up = (ahead_m < 25.0) & (ahead_mps < 0.85 * self.wished_mps(here))
        eager = self.rng.random(len(here)) < np.where(held_up, 0.35, _RARE)
        ready = (self.speed_mps[here] > 5.0) & (self.since_shift_s[here] > 2 * CHANGE_S)
        for user in here[eager & ready & self.present[here]].tolist():
            strip = self.routes.strips[self.route[user]][-1]
            on_strip_m = self.along_m[user] - self.routes.start_m[self.route[user], strip]
            last_m = self.routes.length_m[self.route[user]] - self.along_m[user]
            sides = [self.town.strips[strip].left, self.town.strips[strip].right]
            for beside in sides:
                room = beside >= 0 and on_strip_m > 12.0 and last_m > 30.0
                if room and self._gap_beside(user, beside, on_strip_m, here):
                    self._shift(user, beside, on_strip_m)
                    break

    def _gap_beside(
        self, user: int, beside: int, on_strip_m: float, here: np.ndarray
    ) -> bool:
        """Whether nobody is, or soon will be, beside a user."""
        others = here[here != user]
        reach_m = self.half_m(others) + self.users.size_lwh_m[user, 0] / 2
        start_m = self.routes.start_m[self.route[others], beside]
        apart_m = self.along_m[others] - start_m - on_strip_m
        closing_mps = (self.speed_mps[user] - self.speed_mps[others]) * np.sign(apart_m)
        needed_m = reach_m + 5.0 + 0.6 * self.speed_mps[user] + 3.0 * closing_mps.clip(0.0)
        return bool((np.isnan(apart_m) | (np.abs(apart_m) > needed_m)).all())

    def _shift(self, user: int, beside: int, on_strip_m: float) -> None:
        """Put a user on the route beside, still displaced to where they were."""
        route = self.routes.ending_with(beside)[:1]
        along_m = self.routes.start_m[route, beside] + on_strip_m
        old_m = self.routes.points(self.route[[user]], self.along_m[[user]])[0]
        new_m = self.routes.points(route, along_m)[0]
        ahead_m = self.routes.points(route, along_m + 1.0)[0] - new_m
        left = np.array([-ahead_m[1], ahead_m[0]]) / np.linalg.norm(ahead_m)
        self.shift_m[user] = (old_m - new_m) @ left
        self.since_shift_s[user] = 0.0
        self.route[user], self.along_m[user] = route[0], along_m[0]
