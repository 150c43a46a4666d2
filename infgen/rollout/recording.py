"""Recording: the frames of a simulation, and the rollouts they add up to.

Rows of a batch are used again after the removal of their agent, so each agent has a number
within its rollout, logged agents first.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int16, Int32, Int64

from infgen.clock import CLOCK
from infgen.rollout.heights import ground_z_m
from infgen.rollout.rollout import NEVER, Rollout
from infgen.scene import Scene
from infgen.tokens.scene_tokens import SceneTokens
from infgen.tokens.signals import LoggedSignals

NO_AGENT = -1
"""Agent number of a free row."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One token step of a batch of rollouts.

    Attributes:
        token: The token step: steps ``5 token + 1`` to ``5 token + 5``.
        agent_number: Number of the agent in each row, or ``NO_AGENT``.
        path: x, y, heading of every row at its five steps.
        shown: At which of them it is observed: all, but for weights with validity patterns.
        removed: Rows whose agent is present for the last time.
        inserted_number: Number of the agent inserted at the end of this token step, else
            ``NO_AGENT``; its row is free in ``agent_number``.
        agent_type: ``AgentType`` of every row after this token step.
        size_lwh_m: Box of every row after this token step.
    """

    token: int
    agent_number: Int32[np.ndarray, "rollout row"]
    path: Float32[np.ndarray, "rollout row 5 3"]
    shown: Bool[np.ndarray, "rollout row 5"]
    removed: Bool[np.ndarray, "rollout row"]
    inserted_number: Int32[np.ndarray, "rollout row"]
    agent_type: Int8[np.ndarray, "rollout row"]
    size_lwh_m: Float32[np.ndarray, "rollout row 3"]


@dataclass(frozen=True, slots=True)
class RolloutStart:
    """What a rollout continues: a log and its tokenized history.

    Attributes:
        scene: The log.
        history: Its tokens up to now, nothing later in them.
        index: Which of the scene's rollouts this is.
        seed: Seed of its random streams.
        lights: Signal states at every token step from the first of the history on, for
            weights that use them; None keeps the last known states.
    """

    scene: Scene
    history: SceneTokens
    index: int
    seed: int
    lights: LoggedSignals | None = None

    @property
    def logged_row(self) -> Int32[np.ndarray, " agent"]:
        """Row in the log of each agent of the history."""
        order = np.argsort(self.scene.tracks.id, kind="stable")
        found = np.searchsorted(self.scene.tracks.id[order], self.history.track_id)
        return order[found].astype(np.int32)


def number_maps(
    starts: Sequence[RolloutStart],
) -> tuple[list[RolloutStart], Int64[np.ndarray, " rollout"]]:
    """Return one start per map, and the map of each rollout.

    Scenes are told apart by themselves: a user may have changed one and kept its id.
    """
    maps = {id(start.scene): start for start in starts}
    number = {scene: at for at, scene in enumerate(maps)}
    scene = [number[id(start.scene)] for start in starts]
    return list(maps.values()), np.array(scene, dtype=np.int64)


def collect(
    starts: Sequence[RolloutStart],
    frames: Sequence[Frame],
    weights: str,
    places: Sequence[int] | None = None,
) -> list[Rollout]:
    """Collect the frames of a batch into one rollout per start.

    Args:
        starts: What each rollout of the batch continues.
        frames: All frames, in order.
        weights: Fingerprint of the weights.
        places: Rollouts of the batch to collect; None for all. A rollout holds every agent
            at every step: collect a few at a time to bound memory.
    """
    places = range(len(starts)) if places is None else places
    return [_rollout(starts[at], _record(starts[at], frames, at), weights) for at in places]


@dataclass(frozen=True, slots=True)
class _RecordedAgents:
    """One row per agent of a rollout, filled frame by frame.

    An agent that is ``there`` has a pose; one that is ``valid`` is observed as well.
    """

    pose: Float32[np.ndarray, "agent step 3"]
    there: Bool[np.ndarray, "agent step"]
    valid: Bool[np.ndarray, "agent step"]
    agent_type: Int8[np.ndarray, " agent"]
    size_lwh_m: Float32[np.ndarray, "agent 3"]
    entry_step: Int16[np.ndarray, " agent"]
    exit_step: Int16[np.ndarray, " agent"]


def _record(start: RolloutStart, frames: Sequence[Frame], at: int) -> _RecordedAgents:
    logged = start.history.num_agents
    count = 1 + max(
        [logged - 1, *(int(frame.inserted_number[at].max()) for frame in frames)]
    )
    steps = CLOCK.end_step(frames[-1].token) + 1
    recorded = _RecordedAgents(
        pose=np.zeros((count, steps, 3), dtype=np.float32),
        there=np.zeros((count, steps), dtype=bool),
        valid=np.zeros((count, steps), dtype=bool),
        agent_type=np.zeros(count, dtype=np.int8),
        size_lwh_m=np.zeros((count, 3), dtype=np.float32),
        entry_step=np.zeros(count, dtype=np.int16),
        exit_step=np.full(count, NEVER, dtype=np.int16),
    )
    _write_history(recorded, start)
    for frame in frames:
        _write_frame(recorded, frame, at)
    return recorded


def _write_history(recorded: _RecordedAgents, start: RolloutStart) -> None:
    tracks, rows, now = start.scene.tracks, start.logged_row, start.scene.now
    logged, span = len(rows), slice(0, now + 1)
    seen = tracks.valid[rows, span]
    recorded.there[:logged, span] = recorded.valid[:logged, span] = seen
    recorded.pose[:logged, span, :2] = tracks.xyz_m[rows, span, :2] * seen[..., None]
    recorded.pose[:logged, span, 2] = tracks.heading_rad[rows, span] * seen
    recorded.agent_type[:logged] = start.history.agent_type
    recorded.size_lwh_m[:logged] = start.history.size_lwh_m
    recorded.entry_step[:logged] = seen.argmax(axis=1)


def _write_frame(recorded: _RecordedAgents, frame: Frame, at: int) -> None:
    end = CLOCK.end_step(frame.token)
    span = slice(CLOCK.start_step(frame.token) + 1, end + 1)
    agent_number, inserted_number = frame.agent_number[at], frame.inserted_number[at]
    there, new = agent_number != NO_AGENT, inserted_number != NO_AGENT
    recorded.pose[agent_number[there], span] = frame.path[at][there]
    recorded.there[agent_number[there], span] = True
    recorded.valid[agent_number[there], span] = frame.shown[at][there]
    recorded.exit_step[agent_number[frame.removed[at]]] = end
    recorded.agent_type[inserted_number[new]] = frame.agent_type[at][new]
    recorded.size_lwh_m[inserted_number[new]] = frame.size_lwh_m[at][new]
    recorded.entry_step[inserted_number[new]] = end


def _rollout(start: RolloutStart, recorded: _RecordedAgents, weights: str) -> Rollout:
    count, logged = len(recorded.agent_type), start.history.num_agents
    first_id = int(start.scene.tracks.id.max()) + 1
    inserted_id = np.arange(first_id, first_id + count - logged, dtype=np.int32)
    z_m = _heights(start, recorded)
    return Rollout(
        scenario_id=start.scene.scenario_id,
        index=start.index,
        seed=start.seed,
        weights=weights,
        origin_xyz_m=start.scene.origin_xyz_m,
        now=start.scene.now,
        ego=start.history.ego,
        id=np.concatenate([start.history.track_id, inserted_id]),
        agent_type=recorded.agent_type,
        size_lwh_m=recorded.size_lwh_m,
        xyz_m=np.concatenate([recorded.pose[..., :2], z_m[..., None]], axis=-1)
        * recorded.valid[..., None],
        heading_rad=recorded.pose[..., 2] * recorded.valid,
        valid=recorded.valid,
        logged=np.arange(count) < logged,
        entry_step=recorded.entry_step,
        exit_step=recorded.exit_step,
    )


def _heights(
    start: RolloutStart, recorded: _RecordedAgents
) -> Float32[np.ndarray, "agent step"]:
    """Heights of box centres: the log's in the history, then road plus clearance.

    The clearance of a logged agent is what it had over the road at now, that of an inserted
    one half its height. Roads are looked up once per token step and interpolated.
    """
    tracks, rows, now = start.scene.tracks, start.logged_row, start.scene.now
    logged, stride = len(rows), CLOCK.steps_per_token
    ground_m = _ground_at_knots(start, recorded)
    clearance_m = recorded.size_lwh_m[:, 2] / 2
    clearance_m[:logged] = tracks.xyz_m[rows, now, 2] - ground_m[:logged, 0]

    later = np.arange(recorded.valid.shape[1] - now)
    left = later // stride
    right = np.minimum(left + 1, ground_m.shape[1] - 1)
    share = (later % stride / stride).astype(np.float32)
    z_m = np.zeros(recorded.valid.shape, dtype=np.float32)
    z_m[:, now:] = ground_m[:, left] * (1 - share) + ground_m[:, right] * share
    z_m[:, now:] += clearance_m[:, None]
    z_m[:logged, : now + 1] = tracks.xyz_m[rows, : now + 1, 2]
    return z_m


def _ground_at_knots(
    start: RolloutStart, recorded: _RecordedAgents
) -> Float32[np.ndarray, "life knot"]:
    """Road height at the end of every token step from now on, held where nobody is."""
    knots = np.arange(start.scene.now, recorded.valid.shape[1], CLOCK.steps_per_token)
    history, there = start.history, recorded.there[:, knots]
    ground_m = np.zeros(there.shape, dtype=np.float32)
    xy_m = recorded.pose[:, knots, :2][there]
    ground_m[there] = ground_z_m(xy_m, history.map_pose[:, :2], history.map_z_m)
    # Hold the last known height after an exit, the first known one before an entry.
    last = np.maximum.accumulate(np.where(there, np.arange(len(knots)), -1), axis=1)
    held = np.where(last < 0, there.argmax(axis=1)[:, None], last)
    return np.take_along_axis(ground_m, held, axis=1)
