"""What the formats of others ask of a rollout and its scene, in the world frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int64

from infgen.clock import CLOCK
from infgen.rollout.rollout import Rollout
from infgen.scene import Scene


@dataclass(frozen=True, slots=True)
class States:
    """Everyone of one rollout at every step, world frame; zeros where not ``valid``.

    Attributes:
        id: Track ids; inserted agents count on from the log's largest.
        agent_type: ``AgentType``.
        size_lwh_m: One box per agent.
        xyz_m: Box centres.
        heading_rad: Counter-clockwise from +x.
        velocity_mps: Along x and y: the log's up to now, then by difference to the step
            before (of a first step: to the one after).
        valid: Whether the agent is there.
    """

    id: Int64[np.ndarray, " agent"]
    agent_type: Int8[np.ndarray, " agent"]
    size_lwh_m: Float32[np.ndarray, "agent 3"]
    xyz_m: Float64[np.ndarray, "agent step 3"]
    heading_rad: Float32[np.ndarray, "agent step"]
    velocity_mps: Float64[np.ndarray, "agent step 2"]
    valid: Bool[np.ndarray, "agent step"]


@dataclass(frozen=True, slots=True)
class Lights:
    """Signals of a played scene: the log's while the play looked at them.

    After the last step at which it did, every light stays as it was then.

    Attributes:
        lane_id: Feature ids of the signalled lanes, ascending.
        state: ``SignalState`` of each lane, or ``NO_LIGHT`` where the log has none.
        stop_xyz_m: Where the lane's traffic stops, world frame.
    """

    lane_id: Int64[np.ndarray, " lane"]
    state: Int8[np.ndarray, "lane step"]
    stop_xyz_m: Float64[np.ndarray, "lane 3"]


NO_LIGHT = -1


def states_of(rollout: Rollout, scene: Scene, num_steps: int | None = None) -> States:
    """Give the states of everyone who is there within the first steps (default: all)."""
    steps = slice(0, num_steps)
    rows = np.flatnonzero(rollout.valid[:, steps].any(axis=1))
    valid = rollout.valid[rows, steps]
    xyz_m = rollout.xyz_m[rows, steps].astype(np.float64) + rollout.origin_xyz_m
    velocity_mps = _differences(rollout.xyz_m[rows, steps, :2].astype(np.float64), valid)
    _take_logged(velocity_mps, rollout, rows, scene)
    return States(
        id=rollout.id[rows].astype(np.int64),
        agent_type=rollout.agent_type[rows],
        size_lwh_m=rollout.size_lwh_m[rows],
        xyz_m=np.where(valid[..., None], xyz_m, 0.0),
        heading_rad=np.where(valid, rollout.heading_rad[rows, steps], np.float32(0)),
        velocity_mps=np.where(valid[..., None], velocity_mps, 0.0),
        valid=valid,
    )


def lights_of(scene: Scene, num_steps: int, played: str) -> Lights:
    """Give the state of every light at the first steps of a play.

    Args:
        scene: The log.
        num_steps: How many steps.
        played: What lights showed after the history, as ``rollout.signals`` says: ``now``
            or ``log``. A log is looked at to the end of its last whole half second.
    """
    signals, last = scene.signals, scene.now
    if played == "log":
        last = CLOCK.start_step(CLOCK.num_tokens(scene.tracks.num_steps))
    last = min(last, num_steps - 1)
    known = signals.step <= last
    lane_id, first = np.unique(signals.lane_id[known], return_index=True)
    state = np.full((len(lane_id), num_steps), NO_LIGHT, np.int8)
    lane = np.searchsorted(lane_id, signals.lane_id[known])
    state[lane, signals.step[known]] = signals.state[known]
    state[:, last + 1 :] = state[:, last, None]
    stop_m = signals.stop_xyz_m[known][first].astype(np.float64) + scene.origin_xyz_m
    return Lights(lane_id.astype(np.int64), state, stop_m)


def _differences(
    xy_m: Float64[np.ndarray, "agent step 2"], valid: Bool[np.ndarray, "agent step"]
) -> Float64[np.ndarray, "agent step 2"]:
    """Velocity [agent, step, 2] to the step before, or else to the step after, or none."""
    found = np.zeros(xy_m.shape)
    step_mps = np.diff(xy_m, axis=1) / CLOCK.step_s
    both = (valid[:, 1:] & valid[:, :-1])[..., None]
    found[:, :-1] = np.where(both, step_mps, 0.0)
    found[:, 1:] = np.where(both, step_mps, found[:, 1:])
    return found


def _take_logged(
    velocity_mps: Float64[np.ndarray, "agent step 2"],
    rollout: Rollout,
    rows: Int64[np.ndarray, " agent"],
    scene: Scene,
) -> None:
    """Put the log's velocities of the history in place of differences."""
    tracks = scene.tracks
    order = np.argsort(tracks.id, kind="stable")
    place = np.searchsorted(tracks.id, rollout.id[rows], sorter=order)
    track = order[np.minimum(place, len(order) - 1)]
    same = rollout.logged[rows] & (tracks.id[track] == rollout.id[rows])
    history = slice(0, min(scene.now + 1, velocity_mps.shape[1]))
    logged = tracks.velocity_mps[track[same], history]
    shown = tracks.valid[track[same], history, None]
    velocity_mps[same, history] = np.where(shown, logged, velocity_mps[same, history])
