"""The Intelligent Driver Model drives the environment, from what it observes alone.

It follows its route, keeps its distance, and stops at red signals::

    python examples/idm_environment.py --scene 1 --seconds 20
"""

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np

from infgen.environment import ID
from infgen.environment.observation import AGENTS, EGO, ROUTE_SPACING_M, SIGNALS
from infgen.rollout.bicycle import wheelbase_of

MAX_ACCEL_MPS2, COMFORT_BRAKE_MPS2 = 1.5, 2.0
DESIRED_MPS = 10.0
ASIDE_MPS2 = 2.0
"""Greatest acceleration to the side, in turns."""
HEADWAY_S, STANDING_GAP_M = 1.5, 2.0
BESIDE_M = 1.8
"""Whoever is farther to the side of the route is not in the way."""
PURSUIT_S = 0.6
"""The car steers to where the route is after so long ..."""
PURSUIT_M = 4.0
"""... and no nearer than this."""


def drive(observation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the action: acceleration and steering angle."""
    ego = dict(zip(EGO, observation["ego"].tolist(), strict=True))
    speed_mps, length_m = ego["speed_mps"], ego["length_m"]
    gap_m, closing_mps = gap_ahead(observation, speed_mps, length_m)
    desired_mps = slow_for_turns(observation["route"])
    accel_mps2 = follow(speed_mps, desired_mps, gap_m, closing_mps)
    steering_rad = steer(observation, ego["route_left_m"], speed_mps)
    return np.array([accel_mps2, steering_rad], dtype=np.float32)


def slow_for_turns(route_m: np.ndarray) -> float:
    """Return the speed at which the turns ahead on the route can be reached and driven."""
    way = np.diff(np.concatenate([np.zeros((1, 2)), route_m]), axis=0)
    angle_rad = np.arctan2(way[:, 1], way[:, 0])
    turn_rad = (np.diff(angle_rad, prepend=0.0) + np.pi) % (2 * np.pi) - np.pi
    in_turn_mps2 = ASIDE_MPS2 * ROUTE_SPACING_M / np.maximum(np.abs(turn_rad), 1e-3)
    before_m = ROUTE_SPACING_M * np.arange(len(route_m))
    allowed_mps = np.sqrt(in_turn_mps2 + 2 * COMFORT_BRAKE_MPS2 * before_m)
    return float(min(DESIRED_MPS, allowed_mps.min()))


def follow(speed_mps: float, desired_mps: float, gap_m: float, closing_mps: float) -> float:
    """Return the acceleration of the Intelligent Driver Model (Treiber et al. 2000)."""
    braking = 2 * np.sqrt(MAX_ACCEL_MPS2 * COMFORT_BRAKE_MPS2)
    wanted_m = STANDING_GAP_M + speed_mps * max(0.0, HEADWAY_S + closing_mps / braking)
    free = (speed_mps / desired_mps) ** 4
    return float(MAX_ACCEL_MPS2 * (1 - free - (wanted_m / max(gap_m, 0.1)) ** 2))


def steer(
    observation: Mapping[str, np.ndarray], route_left_m: float, speed_mps: float
) -> float:
    """Return the steering angle that leads to a point of the route (pure pursuit)."""
    length_m = float(observation["ego"][EGO.index("length_m")])
    way_m = np.concatenate([[[0.0, route_left_m]], observation["route"]])
    at_m = max(PURSUIT_M, PURSUIT_S * speed_mps) / ROUTE_SPACING_M
    x_m, y_m = (np.interp(at_m, np.arange(len(way_m)), line) for line in way_m.T)
    per_m = 2 * y_m / max(x_m**2 + y_m**2, 1.0)
    slip_rad = np.arcsin(np.clip(per_m * wheelbase_of(length_m) / 2, -0.9, 0.9))
    return float(np.arctan(2 * np.tan(slip_rad)))


def gap_ahead(
    observation: Mapping[str, np.ndarray], speed_mps: float, length_m: float
) -> tuple[float, float]:
    """Return the free way to whoever is next on the route, and how fast it shrinks."""
    agents = observation["agents"][observation["agents_mask"] > 0]
    lights = observation["signals"][observation["signals_mask"] > 0]
    red = lights[lights[:, SIGNALS.index("is_stop")] > 0]
    red = red[red[:, SIGNALS.index("heading_cos")] > 0.8]
    way_m = np.concatenate([np.zeros((1, 2)), observation["route"]])
    best_m, best_mps = np.inf, 0.0
    for one in agents:
        along_m, aside_m = along(way_m, one[:2])
        gap_m = along_m - (length_m + one[AGENTS.index("length_m")]) / 2
        if aside_m < BESIDE_M and along_m > 0 and gap_m < best_m:
            best_m = float(gap_m)
            best_mps = speed_mps - float(one[AGENTS.index("velocity_x_mps")])
    for one in red:
        along_m, aside_m = along(way_m, one[:2])
        gap_m = along_m - length_m / 2
        if aside_m < BESIDE_M and 0 < gap_m < best_m:
            best_m, best_mps = float(gap_m), speed_mps
    return best_m, best_mps


def along(way_m: np.ndarray, xy_m: np.ndarray) -> tuple[float, float]:
    """Return how far along a line the point nearest to another one is, and how far off."""
    steps = np.diff(way_m, axis=0)
    length_m = np.maximum(np.linalg.norm(steps, axis=1), 1e-6)
    share = ((xy_m - way_m[:-1]) * steps).sum(axis=1) / length_m**2
    share = np.clip(share, 0, 1)
    off_m = np.linalg.norm(xy_m - way_m[:-1] - share[:, None] * steps, axis=1)
    best = int(off_m.argmin())
    before_m = length_m[:best].sum() + share[best] * length_m[best]
    return float(before_m), float(off_m[best])


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive one episode, and print how it goes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scene", type=int, help="number of a built-in scene; else any")
    parser.add_argument("--seconds", type=float, default=60.0, help="longest drive")
    parser.add_argument("--seed", type=int, default=0, help="another seed, other traffic")
    options = parser.parse_args(arguments)
    env: gymnasium.Env[Any, np.ndarray] = gymnasium.make(ID, max_seconds=options.seconds)
    observation, info = env.reset(seed=options.seed, options={"scene": options.scene})
    print("    s   m/s    route m  agents  inserted  removed   return")
    total, ended, steps = 0.0, False, 0
    while not ended:
        observation, reward, terminated, truncated, info = env.step(drive(observation))
        total, ended, steps = total + float(reward), terminated or truncated, steps + 1
        if ended or steps % 10 == 0:
            print(
                f"{info['seconds']:5.1f} {observation['ego'][0]:5.1f} "
                f"{info['route_m']:10.1f} {info['agents']:7d} {info['inserted']:9d} "
                f"{info['removed']:8d} {total:8.2f}"
            )
    how = "off the road" if terminated else "time is up or the route driven"
    print("collision" if info["collisions"] else how)


if __name__ == "__main__":
    main()
