"""One played future of one scene."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int16, Int32

NEVER = -1
"""Exit step of an agent that is still there at the end."""


@dataclass(frozen=True, slots=True)
class Rollout:
    """Who was where at every 0.1 s step, history included.

    Steps 0 to ``now`` are copied from the log; simulation starts at ``now + 1``. World
    frame of the scene (its local origin). Values where ``valid`` is False are zero.

    Attributes:
        scenario_id: Id of the log that the rollout continues.
        index: Which of the scene's rollouts this is.
        seed: Seed of its random streams.
        weights: Fingerprint of the weights that played it.
        origin_xyz_m: World position of the local origin.
        now: Last step of the history.
        ego: Row of the recording car.
        id: Track id of logged agents; inserted agents count on from the largest.
        agent_type: ``AgentType``.
        size_lwh_m: One box per agent.
        xyz_m: Box centres.
        heading_rad: Counter-clockwise from +x.
        valid: Whether the agent exists at that step.
        logged: Whether the agent is of the log (False: inserted).
        entry_step: Step of the pose at which an inserted agent was placed (it is valid from
            the next step on); for logged agents their first valid step.
        exit_step: Last valid step of an agent that left, or ``NEVER``.
    """

    scenario_id: str
    index: int
    seed: int
    weights: str
    origin_xyz_m: Float64[np.ndarray, "3"]
    now: int
    ego: int
    id: Int32[np.ndarray, " agent"]
    agent_type: Int8[np.ndarray, " agent"]
    size_lwh_m: Float32[np.ndarray, "agent 3"]
    xyz_m: Float32[np.ndarray, "agent step 3"]
    heading_rad: Float32[np.ndarray, "agent step"]
    valid: Bool[np.ndarray, "agent step"]
    logged: Bool[np.ndarray, " agent"]
    entry_step: Int16[np.ndarray, " agent"]
    exit_step: Int16[np.ndarray, " agent"]

    @property
    def num_steps(self) -> int:
        """Number of 0.1 s steps, history included."""
        return int(self.valid.shape[1])
