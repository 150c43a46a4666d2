"""Rollouts as a table: one row per rollout, agent and step at which it is there."""

from collections.abc import Mapping, Sequence

import numpy as np

from infgen.clock import CLOCK
from infgen.exports.states import states_of
from infgen.rollout.rollout import Rollout
from infgen.scene import Scene

Columns = Mapping[str, np.ndarray]


def rows_of(rollouts: Sequence[Rollout], scene: Scene) -> Columns:
    """Lay the rollouts of one scene end to end, in order of rollout, agent and step.

    Columns: ``rollout``; ``agent`` (track id); ``agent_type`` (``AgentType``); ``step`` and
    ``time_s`` (0 is now); ``x_m``, ``y_m``, ``z_m`` (world frame, float64);
    ``heading_rad``; ``velocity_x_mps`` and ``velocity_y_mps``; ``length_m``, ``width_m``,
    ``height_m``; ``is_ego``; ``is_logged`` (False: inserted); ``is_history`` (not played).
    """
    parts = [_rows(rollout, scene) for rollout in rollouts]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _rows(rollout: Rollout, scene: Scene) -> Columns:
    states = states_of(rollout, scene)
    agent, step = np.nonzero(states.valid)
    logged = rollout.id[rollout.logged]
    ego = rollout.id[rollout.ego]
    return {
        "rollout": np.full(len(agent), rollout.index, np.int32),
        "agent": states.id[agent],
        "agent_type": states.agent_type[agent],
        "step": step.astype(np.int32),
        "time_s": np.round(CLOCK.step_s * (step - rollout.now), 3),
        **dict(zip(("x_m", "y_m", "z_m"), states.xyz_m[agent, step].T, strict=True)),
        "heading_rad": states.heading_rad[agent, step],
        "velocity_x_mps": states.velocity_mps[agent, step, 0].astype(np.float32),
        "velocity_y_mps": states.velocity_mps[agent, step, 1].astype(np.float32),
        "length_m": states.size_lwh_m[agent, 0],
        "width_m": states.size_lwh_m[agent, 1],
        "height_m": states.size_lwh_m[agent, 2],
        "is_ego": states.id[agent] == ego,
        "is_logged": np.isin(states.id[agent], logged),
        "is_history": step <= rollout.now,
    }
