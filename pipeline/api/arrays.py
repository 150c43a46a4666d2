"""Anyone's simulated futures, as plain arrays: made into rollouts, and scored."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float32, Int64

from infgen.rollout.rollout import NEVER, Rollout
from infgen.scene import Scene
from pipeline.api.rollouts import SceneRollouts
from pipeline.api.scoring import Reference, SceneScores, score_rollouts

MAX_JUMP_M = 50.0
"""Agents whose median is farther from where they are now are in another frame."""
FOREIGN = "arrays"
"""Stands for the fingerprint of weights that are not known."""


class ArraysError(ValueError):
    """Arrays that are no rollouts of a scene."""


def score(
    rollouts: SceneRollouts | Sequence[Rollout] | np.ndarray,
    scene: Scene,
    *,
    metric: str = "wosac-2025",
    object_id: Sequence[int] | np.ndarray | None = None,
    valid: np.ndarray | None = None,
    frame: Literal["scene", "world"] = "scene",
    reference: Reference | None = None,
    presence_radius_m: float = 0.0,
) -> SceneScores:
    """Score the rollouts of one scene: ours, or anyone's as arrays.

    Args:
        rollouts: From ``simulator.rollout``; or poses ``[rollout, agent, step, 3 or 4]``
            as ``rollouts_from_arrays`` takes them.
        scene: The log that they continue.
        metric: ``wosac-2025``, ``-2024`` or ``-2023``: Waymo's metric over the first 80
            steps after now, for which every agent that is observed now must be simulated,
            officially 32 times. ``paper`` or ``corrected``: the long-term protocols, for
            rollouts of 8 s and more with agents that enter and leave.
        object_id: Of arrays; as in ``rollouts_from_arrays``.
        valid: Of arrays; as in ``rollouts_from_arrays``.
        frame: Of arrays; as in ``rollouts_from_arrays``.
        reference: Of the long-term protocols: the logs of the scene's split, from
            ``infgen.open_reference``.
        presence_radius_m: Of the long-term protocols, for simulators that neither insert
            nor remove: agents enter and exit where they cross this distance from the ego; 0
            for no limit.

    Raises:
        ConfigError: for a metric that does not exist or needs a reference.
        ArraysError: for arrays that are no rollouts of the scene.
        ValueError: if the rollouts do not fit the log, or the log cannot be scored; the
            message says how.
    """
    if isinstance(rollouts, np.ndarray):
        rollouts = rollouts_from_arrays(
            rollouts, scene, object_id=object_id, valid=valid, frame=frame
        )
    return score_rollouts(tuple(rollouts), scene, metric, reference, presence_radius_m)


def rollouts_from_arrays(
    poses: np.ndarray,
    scene: Scene,
    *,
    object_id: Sequence[int] | np.ndarray | None = None,
    valid: np.ndarray | None = None,
    frame: Literal["scene", "world"] = "scene",
    agent_type: Sequence[int] | np.ndarray | None = None,
    size_lwh_m: np.ndarray | None = None,
) -> SceneRollouts:
    """Make rollouts of arrays, to be looked at, scored or saved as ours.

    Agents that are observed now continue their history. Others are inserted where they are
    valid for the first time.

    Args:
        poses: ``[rollout, agent, step, 3 or 4]``: x, y, heading, or x, y, z, heading, of
            every agent at every 0.1 s step after now, in metres and radians. Without z
            agents keep that of now, inserted ones the ego's.
        scene: The log that they continue.
        object_id: ``[agent]``: track ids, the ego's among them; if None, those of all
            agents that are observed now, in the order of ``scene.tracks``.
        valid: ``[rollout, agent, step]``: whether an agent is there; always if None.
        frame: ``scene``: as ``scene.tracks.xyz_m``. ``world``: as in the records, which is
            ``scene.origin_xyz_m`` more.
        agent_type: ``[agent]``: ``AgentType``; needed for agents the log does not have.
        size_lwh_m: ``[agent, 3]``: boxes; needed for agents the log does not have.

    Raises:
        ArraysError: naming what does not fit.
    """
    ids = _ids(scene, object_id)
    agents = _Agents.of(scene, ids, agent_type, size_lwh_m)
    states = _states(np.asarray(poses), scene, agents, frame)
    there = np.ones(states.shape[:3], dtype=bool) if valid is None else np.asarray(valid)
    if there.shape != states.shape[:3] or there.dtype != np.bool_:
        raise ArraysError(
            f"valid is {there.dtype} of shape {there.shape}; expected bool of shape "
            f"{states.shape[:3]}"
        )
    _check_values(states, there, scene, agents)
    rollouts = [
        _rollout(scene, agents, at, one, shown)
        for at, (one, shown) in enumerate(zip(states, there, strict=True))
    ]
    return SceneRollouts(scene, tuple(rollouts), None)


@dataclass(frozen=True, slots=True)
class _Agents:
    """The agents of some arrays.

    Attributes:
        id: Track ids.
        row: Row of each in the log; -1 for those it does not have.
        now: Whether the log observes them now.
        agent_type: ``AgentType``.
        size_lwh_m: Boxes.
    """

    id: Int64[np.ndarray, " agent"]
    row: Int64[np.ndarray, " agent"]
    now: Bool[np.ndarray, " agent"]
    agent_type: np.ndarray
    size_lwh_m: Float32[np.ndarray, "agent 3"]

    @classmethod
    def of(
        cls, scene: Scene, ids: np.ndarray, agent_type: Any, size_lwh_m: Any
    ) -> "_Agents":
        """Take what the log knows of them, and what is given of the others."""
        tracks = scene.tracks
        rows = {int(number): at for at, number in enumerate(tracks.id)}
        row = np.array([rows.get(int(number), -1) for number in ids], dtype=np.int64)
        for name, given in (("agent_type", agent_type), ("size_lwh_m", size_lwh_m)):
            if given is None and (row < 0).any():
                raise ArraysError(
                    f"agent {ids[row < 0][0]} is not in the log; {name} must be given"
                )
            if given is not None and len(given) != len(ids):
                raise ArraysError(
                    f"{name} has {len(given)} rows; expected {len(ids)}, one per agent"
                )
        seen = np.maximum(1, tracks.valid[row].sum(axis=1))[:, None]
        mean_m = (tracks.size_lwh_m[row] * tracks.valid[row, :, None]).sum(axis=1) / seen
        now = (row >= 0) & tracks.valid[row, scene.now]
        own_m = np.where(now[:, None], tracks.size_lwh_m[row, scene.now], mean_m)
        return cls(
            id=ids,
            row=row,
            now=now,
            agent_type=tracks.agent_type[row] if agent_type is None else agent_type,
            size_lwh_m=(own_m if size_lwh_m is None else np.asarray(size_lwh_m)).astype(
                np.float32
            ),
        )


def _ids(scene: Scene, object_id: Any) -> Int64[np.ndarray, " agent"]:
    """Track ids as given, or of all agents observed now."""
    tracks = scene.tracks
    if object_id is None:
        return tracks.id[tracks.valid[:, scene.now]].astype(np.int64)
    ids = np.asarray(object_id, dtype=np.int64)
    if ids.ndim != 1 or len(np.unique(ids)) != len(ids):
        raise ArraysError("object_id must have one dimension, and each id once")
    if tracks.id[scene.ego] not in ids:
        raise ArraysError(f"object_id lacks the ego, agent {tracks.id[scene.ego]}")
    return ids


def _states(
    poses: np.ndarray, scene: Scene, agents: _Agents, frame: str
) -> Float32[np.ndarray, "rollout agent step 4"]:
    """Bring poses to x, y, z, heading in the scene's frame.

    Raises:
        ArraysError: if they are not of the right shape.
    """
    shape = f"[rollout, {len(agents.id)} agents, step, 3 or 4]"
    fits = poses.ndim == 4 and poses.shape[1] == len(agents.id) and poses.shape[3] in (3, 4)
    if not fits or not poses.size or poses.dtype.kind != "f":
        raise ArraysError(
            f"poses are {poses.dtype} of shape {poses.shape}; expected floats {shape}"
        )
    if frame not in ("scene", "world"):
        raise ArraysError(f"frame is {frame!r}; expected 'scene' or 'world'")
    states = poses.astype(np.float64)
    if poses.shape[3] == 3:
        tracks, now = scene.tracks, scene.now
        held_m = np.where(agents.now, agents.row, scene.ego)
        z_m = np.broadcast_to(
            tracks.xyz_m[held_m, now, 2][None, :, None, None], (*poses.shape[:3], 1)
        )
        z_m = z_m + (scene.origin_xyz_m[2] if frame == "world" else 0.0)
        states = np.concatenate([states[..., :2], z_m, states[..., 2:]], axis=-1)
    if frame == "world":
        states[..., :3] -= scene.origin_xyz_m
    return states.astype(np.float32)


def _check_values(
    states: np.ndarray, there: np.ndarray, scene: Scene, agents: _Agents
) -> None:
    """Refuse values that are not finite, and those of another frame."""
    wrong = ~np.isfinite(states).all(axis=-1) & there
    if wrong.any():
        rollout, agent, step = np.argwhere(wrong)[0]
        raise ArraysError(
            f"rollout {rollout}, agent {agents.id[agent]}, step {step} after now holds a "
            "value that is not finite; valid= says where an agent is not there"
        )
    first = states[:, agents.now, 0, :2][there[:, agents.now, 0]]
    rows = np.broadcast_to(agents.row[agents.now], there[:, agents.now, 0].shape)
    now_m = scene.tracks.xyz_m[rows[there[:, agents.now, 0]], scene.now, :2]
    jump_m = float(np.median(np.linalg.norm(first - now_m, axis=-1))) if len(first) else 0.0
    if jump_m > MAX_JUMP_M:
        raise ArraysError(
            f"agents begin {jump_m:.0f} m from where they are now (median); poses in the "
            "coordinates of the records need frame='world', others frame='scene'"
        )


def _rollout(
    scene: Scene, agents: _Agents, index: int, states: np.ndarray, there: np.ndarray
) -> Rollout:
    """Put the logged history before what is given, and note who enters and leaves."""
    tracks, history = scene.tracks, slice(0, scene.now + 1)
    keep = np.flatnonzero(agents.now | there.any(axis=1))
    logged, rows = agents.now[keep], agents.row[keep]
    seen = tracks.valid[rows, history] & logged[:, None]
    valid = np.concatenate([seen, there[keep]], axis=1)
    xyz_m = np.concatenate([tracks.xyz_m[rows, history], states[keep, :, :3]], axis=1)
    heading = np.concatenate(
        [tracks.heading_rad[rows, history], states[keep, :, 3]], axis=1
    )
    steps = valid.shape[1]
    first = valid.argmax(axis=1)
    entry = np.where(logged, first, np.maximum(first - 1, scene.now + 1))
    last = steps - 1 - valid[:, ::-1].argmax(axis=1)
    return Rollout(
        scenario_id=scene.scenario_id,
        index=index,
        seed=0,
        weights=FOREIGN,
        origin_xyz_m=scene.origin_xyz_m,
        now=scene.now,
        ego=int(np.flatnonzero(agents.id[keep] == tracks.id[scene.ego])[0]),
        id=agents.id[keep].astype(np.int32),
        agent_type=np.asarray(agents.agent_type)[keep].astype(np.int8),
        size_lwh_m=agents.size_lwh_m[keep],
        xyz_m=np.where(valid[..., None], xyz_m, np.float32(0)),
        heading_rad=np.where(valid, heading, np.float32(0)),
        valid=valid,
        logged=logged,
        entry_step=entry.astype(np.int16),
        exit_step=np.where(last < steps - 1, last, NEVER).astype(np.int16),
    )
