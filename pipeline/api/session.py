"""A session that a planner drives, and the rollouts that come of it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from infgen.rollout.recording import Frame, RolloutStart, collect
from infgen.rollout.session import Session
from infgen.rollout.simulator import Simulator
from pipeline.api.rollouts import SceneRollouts
from pipeline.api.threads import one_thread


class PlannerSession(Session):
    """Traffic that goes on half a second with every ``step(ego_pose)``, and is recorded.

    Attributes:
        population: All agents at the end of the last token step.
        token: Index of that token step.
    """

    def __init__(
        self, simulator: Simulator, starts: Sequence[RolloutStart], weights: str
    ) -> None:
        with one_thread():
            super().__init__(simulator, starts)
        self._weights = weights
        self._settings = simulator.settings
        self._frames: list[Frame] = []

    def step(self, ego_pose: Float32[np.ndarray, "*steps 3"] | None = None) -> Frame:
        """Simulate the next token step; other agents react to the ego one token step later.

        Args:
            ego_pose: Pose of the ego (x, y, heading in the frame of the scene) at the end
                of the token step [3], or at each of its five steps [5, 3]; with a first
                dimension of rollouts for several. None lets the network drive.
        """
        with one_thread():
            frame = super().step(ego_pose)
        self._frames.append(frame)
        return frame

    def rollouts(self) -> SceneRollouts:
        """Return what has happened so far, to be looked at, scored or saved.

        Raises:
            ValueError: before the first step.
        """
        if not self._frames:
            raise ValueError("nothing has happened yet; call step() first")
        found = collect(self._starts, self._frames, self._weights)
        return SceneRollouts(self._starts[0].scene, tuple(found), self._settings)
