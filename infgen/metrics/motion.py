"""Moving boxes as arrays: what every feature is measured on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int8


@dataclass(frozen=True, slots=True)
class Motion:
    """Boxes that move together in one or more rollouts of one scene.

    Attributes:
        x_m: Box centres.
        y_m: Box centres.
        z_m: Box centres.
        heading_rad: Counter-clockwise from +x, not necessarily wrapped.
        size_lwh_m: Length, width and height of each box.
        agent_type: ``AgentType``.
        valid: Whether the box is there.
    """

    x_m: Float32[np.ndarray, "rollout agent step"]
    y_m: Float32[np.ndarray, "rollout agent step"]
    z_m: Float32[np.ndarray, "rollout agent step"]
    heading_rad: Float32[np.ndarray, "rollout agent step"]
    size_lwh_m: Float32[np.ndarray, "agent 3"]
    agent_type: Int8[np.ndarray, " agent"]
    valid: Bool[np.ndarray, "rollout agent step"]

    @property
    def num_rollouts(self) -> int:
        """Number of rollouts."""
        return int(self.x_m.shape[0])

    @property
    def num_agents(self) -> int:
        """Number of boxes."""
        return int(self.x_m.shape[1])
