"""Simple futures of a log to score: the log itself, kept speed, and the log with noise.

They have known orderings, so a scorer that ranks them otherwise is wrong.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32

from infgen.metrics.motion import Motion
from infgen.metrics.placement import Events
from infgen.metrics.traffic import Traffic
from infgen.metrics.wosac.logged import FUTURE_STEPS, HISTORY_STEPS, LoggedScene
from infgen.metrics.wosac.rollouts import Rollouts

NOISE_M = 1.0
"""Standard deviation of the noise at the end of eight seconds, along each axis."""
NOISE_RAD = 0.05


def hold_valid(
    values: Float32[np.ndarray, "agent step"], valid: Bool[np.ndarray, "agent step"]
) -> Float32[np.ndarray, "agent step"]:
    """Replace what was not observed by the last value that was."""
    last = np.maximum.accumulate(np.where(valid, np.arange(valid.shape[1]), 0), axis=1)
    return np.take_along_axis(values, last, axis=1)


def smooth_noise(
    random: np.random.Generator, shape: tuple[int, ...]
) -> Float32[np.ndarray, "*shape"]:
    """A drift that starts at zero and reaches a standard deviation of one at the end.

    A straight line and a slow wave, so that speeds change little and without jumps.
    """
    steps = np.arange(1, shape[-1] + 1, dtype=np.float32) / FUTURE_STEPS
    line, wave = random.normal(size=(2, *shape[:-1], 1)).astype(np.float32)
    return steps * (0.8 * line + 0.6 * wave * np.sin(np.pi * steps / 2))


def logged_future(log: LoggedScene, count: int) -> Rollouts:
    """Play the log, last observed state held."""
    return _noisy_future(log, count, 0, 0.0)


def noisy_future(log: LoggedScene, count: int, seed: int) -> Rollouts:
    """Play the log with smooth noise on places and headings."""
    return _noisy_future(log, count, seed, 1.0)


def _noisy_future(log: LoggedScene, count: int, seed: int, scale: float) -> Rollouts:
    rows = log.sim_rows
    random = np.random.default_rng(seed)
    shape = (count, len(rows), FUTURE_STEPS)

    def played(values: np.ndarray, deviation: float) -> np.ndarray:
        held = hold_valid(values[rows], log.valid[rows])[:, HISTORY_STEPS:]
        noise = smooth_noise(random, shape) * np.float32(deviation * scale)
        return (held + noise).astype(np.float32)

    return Rollouts(
        scenario_id=log.scenario_id,
        object_id=log.id[rows].astype(np.int64),
        x_m=played(log.x_m, NOISE_M),
        y_m=played(log.y_m, NOISE_M),
        z_m=played(log.z_m, 0.0),
        heading_rad=played(log.heading_rad, NOISE_RAD),
    )


def constant_velocity(log: LoggedScene, count: int) -> Rollouts:
    """Keep everyone's velocity of the last step, and the heading."""
    rows, now = log.sim_rows, HISTORY_STEPS - 1
    steps = np.arange(1, FUTURE_STEPS + 1, dtype=np.float32)
    known = log.valid[rows, now - 1]

    def played(values: np.ndarray, *, moves: bool) -> np.ndarray:
        change = (values[rows, now] - values[rows, now - 1]) * known * moves
        path = values[rows, now, None] + change[:, None] * steps
        return np.broadcast_to(path.astype(np.float32), (count, *path.shape))

    return Rollouts(
        scenario_id=log.scenario_id,
        object_id=log.id[rows].astype(np.int64),
        x_m=played(log.x_m, moves=True),
        y_m=played(log.y_m, moves=True),
        z_m=played(log.z_m, moves=False),
        heading_rad=played(log.heading_rad, moves=False),
    )


def noisy_traffic(traffic: Traffic, seed: int) -> Traffic:
    """Drift every agent of a log after now; who comes and goes stays as logged."""
    random = np.random.default_rng(seed)
    motion, future = traffic.motion, traffic.future

    def drift(values: np.ndarray, deviation: float) -> np.ndarray:
        drifted = values.copy()
        shape = values[..., future].shape
        drifted[..., future] += smooth_noise(random, shape) * np.float32(deviation)
        return drifted

    drifted = replace(
        motion,
        x_m=drift(motion.x_m, NOISE_M),
        y_m=drift(motion.y_m, NOISE_M),
        heading_rad=drift(motion.heading_rad, NOISE_RAD),
    )
    return replace(traffic, motion=drifted, index=0)


def kept_velocity(traffic: Traffic, num_steps: int) -> Traffic:
    """Let everyone who is there now keep going; nobody enters or leaves."""
    motion, now = traffic.motion, traffic.now
    rows = np.flatnonzero(traffic.there_now)
    known = motion.valid[:, rows, now - 1]
    steps = np.arange(1, num_steps + 1, dtype=np.float32)

    def kept(values: np.ndarray, *, moves: bool) -> np.ndarray:
        values = values[:, rows]
        change = (values[..., now] - values[..., now - 1]) * known * moves
        path = values[..., now, None] + change[..., None] * steps
        return np.concatenate([values[..., : now + 1], path.astype(np.float32)], axis=-1)

    valid = motion.valid[:, rows, : now + 1]
    future = np.ones((*valid.shape[:2], num_steps), dtype=bool)
    nothing = np.zeros(0, np.int16), np.zeros(0, np.float32)
    return Traffic(
        scenario_id=traffic.scenario_id,
        index=0,
        now=now,
        ego=int(np.searchsorted(rows, traffic.ego)),
        motion=Motion(
            x_m=kept(motion.x_m, moves=True),
            y_m=kept(motion.y_m, moves=True),
            z_m=kept(motion.z_m, moves=False),
            heading_rad=kept(motion.heading_rad, moves=False),
            size_lwh_m=motion.size_lwh_m[rows],
            agent_type=motion.agent_type[rows],
            valid=np.concatenate([valid, future], axis=-1),
        ),
        events=Events(*nothing, *nothing),
    )
