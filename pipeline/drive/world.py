"""The world around the driven ego, one token step after the other."""

import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32

from infgen.rollout.population import EGO_ROW, Population
from infgen.rollout.recording import NOBODY, Frame, RolloutStart
from infgen.rollout.session import Session
from infgen.rollout.simulator import Simulator


@dataclass(frozen=True, slots=True)
class WorldStep:
    """One simulated token step.

    Attributes:
        frame: Who moves where.
        driven: Whether the ego went where it was planned, or as the network chose.
        seconds: Time that it took to simulate.
    """

    frame: Frame
    driven: bool
    seconds: float

    @property
    def ego_path(self) -> Float32[np.ndarray, "5 3"]:
        """Poses of the ego at the five steps."""
        return self.frame.path[0, EGO_ROW]

    @property
    def present(self) -> Bool[np.ndarray, " row"]:
        """Rows that hold an agent throughout."""
        return self.frame.agent_number[0] != NOBODY

    @property
    def num_inserted(self) -> int:
        """Agents that enter at its end."""
        return int((self.frame.inserted_number[0] != NOBODY).sum())

    @property
    def num_removed(self) -> int:
        """Agents that are there for the last time."""
        return int(self.frame.removed[0].sum())


class World:
    """A session with one rollout, whose ego may be driven."""

    def __init__(self, simulator: Simulator, start: RolloutStart) -> None:
        """Feed the history to the network.

        Raises:
            ValueError: if the scene cannot be simulated.
        """
        self.simulator, self.start = simulator, start
        self._session = Session(simulator, start)
        history = start.history
        self._num_logged = history.num_agents
        first_id = int(start.scene.tracks.id.max()) + 1 - self._num_logged
        self._first_id, self._track_id = first_id, history.track_id

    @property
    def population(self) -> Population:
        """All agents at the end of the last token step."""
        return self._session.population

    @property
    def ego_pose(self) -> Float32[np.ndarray, "3"]:
        """Pose of the ego at the end of the last token step."""
        return self._session.ego_pose[0].copy()

    @property
    def ego_length_m(self) -> float:
        """Length of its box."""
        return float(self.start.history.size_lwh_m[self.start.history.ego, 0])

    @property
    def ego_speed_mps(self) -> float:
        """Speed of the ego in the log at the end of the history."""
        scene = self.start.scene
        return float(np.hypot(*scene.tracks.velocity_mps[scene.ego, scene.now]))

    def step(
        self,
        correction: Float32[np.ndarray, "3"] | None = None,
        plan: Float32[np.ndarray, "5 3"] | None = None,
    ) -> WorldStep:
        """Simulate the next token step.

        Args:
            correction: Where the ego is at its beginning, if not where it was planned.
            plan: Where it will be at the five steps; None lets the network drive it.
        """
        begun = time.perf_counter()
        if correction is not None:
            self._session.correct_ego(correction[None])
        frame = self._session.step(plan)
        return WorldStep(frame, plan is not None, time.perf_counter() - begun)

    def ids(self, number: Int32[np.ndarray, " agent"]) -> Int32[np.ndarray, " agent"]:
        """Return the track ids of agents by their numbers, as recordings have them."""
        logged = number < self._num_logged
        own = self._track_id[np.where(logged, number, 0)]
        return np.where(logged, own, self._first_id + number).astype(np.int32)
