"""Simulated futures as anyone hands them in, checked against the log they continue."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from infgen.metrics.motion import Motion
from infgen.metrics.wosac.logged import (
    FUTURE_STEPS,
    HISTORY_STEPS,
    LOG_STEPS,
    NOW,
    LoggedScene,
)
from infgen.rollout.rollout import Rollout

MAX_LISTED = 5
"""Ids named in a message before the rest is counted."""


class RolloutsError(ValueError):
    """Rollouts that do not fit the log they are scored against."""


@dataclass(frozen=True, slots=True)
class Rollouts:
    """Simulated futures of one scene, world frame.

    Attributes:
        scenario_id: Id of the log.
        object_id: Track ids, in any order.
        x_m: Box centres at steps 11 to 90; for scenario generation at all 91 steps.
        y_m: Box centres.
        z_m: Box centres.
        heading_rad: Counter-clockwise from +x.
        size_lwh_m: Boxes that scenario generation chose; ignored by the other versions.
    """

    scenario_id: str
    object_id: Int64[np.ndarray, " object"]
    x_m: Float32[np.ndarray, "rollout object step"]
    y_m: Float32[np.ndarray, "rollout object step"]
    z_m: Float32[np.ndarray, "rollout object step"]
    heading_rad: Float32[np.ndarray, "rollout object step"]
    size_lwh_m: Float32[np.ndarray, "rollout object 3"] | None = None


def from_rollouts(rollouts: Sequence[Rollout]) -> Rollouts:
    """Gather the rollouts of one scene, cut to the eight seconds after now.

    Only agents that live through all of it, in every rollout, are taken.

    Raises:
        RolloutsError: if a rollout is shorter, or there is none.
    """
    if not rollouts:
        raise RolloutsError("there are no rollouts")
    first = rollouts[0]
    steps = slice(first.now + 1, first.now + 1 + FUTURE_STEPS)
    for one in rollouts:
        if one.num_steps < steps.stop:
            raise RolloutsError(
                f"scene {one.scenario_id}: rollout {one.index} has "
                f"{one.num_steps - steps.start} steps after now; expected {FUTURE_STEPS}"
            )
    through = [
        one.id[one.logged & one.valid[:, steps.start : steps.stop].all(axis=1)]
        for one in rollouts
    ]
    ids = through[0]
    for others in through[1:]:
        ids = ids[np.isin(ids, others)]
    rows = [_rows(one.id, ids) for one in rollouts]
    xyz_m = np.stack(
        [one.xyz_m[row, steps] for one, row in zip(rollouts, rows, strict=True)]
    )
    world_m = (xyz_m.astype(np.float64) + first.origin_xyz_m).astype(np.float32)
    heading_rad = [
        one.heading_rad[row, steps] for one, row in zip(rollouts, rows, strict=True)
    ]
    return Rollouts(
        scenario_id=first.scenario_id,
        object_id=ids.astype(np.int64),
        x_m=np.ascontiguousarray(world_m[..., 0]),
        y_m=np.ascontiguousarray(world_m[..., 1]),
        z_m=np.ascontiguousarray(world_m[..., 2]),
        heading_rad=np.stack(heading_rad),
    )


def simulated_part(log: LoggedScene, rollouts: Rollouts) -> LoggedScene:
    """Leave agents of type "other" out of a log if its rollouts simulate none of them.

    Cones, barriers and riderless bicycles of other sources are no sim agents. No record of
    WOMD has agents of this type, so that its scores are the official ones.
    """
    if np.isin(log.id[log.others], rollouts.object_id).any():
        return log
    return log.road_users_only()


def played(log: LoggedScene, rollouts: Rollouts) -> Motion:
    """Put the logged history before the simulated steps; boxes keep their size of now.

    Raises:
        RolloutsError: saying what does not fit.
    """
    check(log, rollouts, FUTURE_STEPS)
    rows, order = log.sim_rows, _rows(rollouts.object_id, log.id[log.sim_rows])

    def join(logged: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        history = logged[rows, :HISTORY_STEPS]
        history = np.broadcast_to(history, (len(simulated), *history.shape))
        return np.concatenate([history, simulated[:, order]], axis=2)

    return Motion(
        x_m=join(log.x_m, rollouts.x_m),
        y_m=join(log.y_m, rollouts.y_m),
        z_m=join(log.z_m, rollouts.z_m),
        heading_rad=join(log.heading_rad, rollouts.heading_rad),
        size_lwh_m=log.size_lwh_m[rows],
        agent_type=log.agent_type[rows],
        valid=join(log.valid, np.ones(rollouts.x_m.shape, dtype=bool)),
    )


def generated(log: LoggedScene, rollouts: Rollouts) -> Iterator[Motion]:
    """Yield each rollout of a generated scene, all 91 steps of it, with its own boxes.

    Raises:
        RolloutsError: saying what does not fit.
    """
    check(log, rollouts, LOG_STEPS)
    rows, order = log.sim_rows, _rows(rollouts.object_id, log.id[log.sim_rows])
    sizes = rollouts.size_lwh_m
    for one in range(len(rollouts.x_m)):
        yield Motion(
            x_m=rollouts.x_m[one : one + 1, order],
            y_m=rollouts.y_m[one : one + 1, order],
            z_m=rollouts.z_m[one : one + 1, order],
            heading_rad=rollouts.heading_rad[one : one + 1, order],
            size_lwh_m=log.size_lwh_m[rows] if sizes is None else sizes[one, order],
            agent_type=log.agent_type[rows],
            valid=np.ones((1, len(rows), LOG_STEPS), dtype=bool),
        )


def check(log: LoggedScene, rollouts: Rollouts, num_steps: int) -> None:
    """Refuse rollouts that do not continue the log.

    Raises:
        RolloutsError: in one line, naming the first thing that is wrong.
    """
    where = f"scene {rollouts.scenario_id}"
    if rollouts.scenario_id != log.scenario_id:
        raise RolloutsError(f"{where}: the log is of scene {log.scenario_id}")
    if not len(rollouts.x_m):
        raise RolloutsError(f"{where}: there are no rollouts")
    if rollouts.x_m.shape[2] != num_steps:
        raise RolloutsError(
            f"{where}: trajectories have {rollouts.x_m.shape[2]} steps; expected "
            f"{num_steps}{_steps_hint(rollouts.x_m.shape[2])}"
        )
    ids, counts = np.unique(rollouts.object_id, return_counts=True)
    expected = log.id[log.sim_rows]
    wrong = (
        ("agents given twice", ids[counts > 1]),
        (f"agents missing of {len(expected)} observed now", np.setdiff1d(expected, ids)),
        ("agents that the log does not show now", np.setdiff1d(ids, expected)),
    )
    for what, found in wrong:
        if len(found):
            raise RolloutsError(f"{where}: {len(found)} {what}: {list_ids(found)}")
    values = np.stack([rollouts.x_m, rollouts.y_m, rollouts.z_m, rollouts.heading_rad])
    if not np.isfinite(values).all():
        _, rollout, row, step = np.argwhere(~np.isfinite(values))[0]
        raise RolloutsError(
            f"{where}: rollout {rollout}, agent {rollouts.object_id[row]}, step {step} "
            "holds a value that is not finite"
        )


def list_ids(ids: np.ndarray) -> str:
    """Name a few ids and count the rest."""
    named = ", ".join(str(one) for one in ids[:MAX_LISTED])
    rest = len(ids) - MAX_LISTED
    return f"{named} and {rest} more" if rest > 0 else named


def _steps_hint(found: int) -> str:
    if found == LOG_STEPS:
        return f" (those after step {NOW}, without the history)"
    return ""


def _rows(ids: np.ndarray, wanted: np.ndarray) -> Int64[np.ndarray, " agent"]:
    """Row of each wanted id."""
    order = np.argsort(ids, kind="stable")
    return order[np.searchsorted(ids, wanted, sorter=order)]
