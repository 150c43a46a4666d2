"""A session that a planner drives, and the rollouts that come of it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from infgen.rollout.begun_step import BegunStep
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

    def begin_step(
        self,
        ego_pose: Float32[np.ndarray, "*steps 3"] | None = None,
        *,
        driven: bool = False,
    ) -> BegunStep:
        """Let all agents choose what they do in the next token step."""
        with one_thread():
            return super().begin_step(ego_pose, driven=driven)

    def end_step(
        self,
        begun: BegunStep,
        ego_pose: Float32[np.ndarray, "*steps 3"] | None = None,
    ) -> Frame:
        """End a token step that has begun: agents are inserted."""
        with one_thread():
            frame = super().end_step(begun, ego_pose)
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
