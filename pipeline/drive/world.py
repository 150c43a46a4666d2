"""The world around the driven ego, one token step after the other."""

import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32

from infgen.rollout.begun_step import BegunStep
from infgen.rollout.population import Population
from infgen.rollout.recording import NO_AGENT, Frame, RolloutStart
from infgen.rollout.session import Session
from infgen.rollout.simulator import Simulator


@dataclass(frozen=True, slots=True)
class WorldStep:
    """A token step that has begun, and the end of the one before it.

    Attributes:
        token: The token step that has begun.
        begun: Who moves where in it.
        ended: The one before it as it was driven; None at the beginning of a drive.
        seconds: Time that both took to simulate.
    """

    token: int
    begun: BegunStep
    ended: Frame | None
    seconds: float

    @property
    def driven(self) -> bool:
        """Whether the ego goes where it is planned to, or as the network chose."""
        return self.begun.ego_is_driven

    @property
    def path(self) -> Float32[np.ndarray, "row 5 3"]:
        """Poses of all rows at the five steps."""
        return self.begun.path[0]

    @property
    def present(self) -> Bool[np.ndarray, " row"]:
        """Rows that hold an agent throughout."""
        return self.begun.there[0]

    @property
    def removed(self) -> Bool[np.ndarray, " row"]:
        """Rows whose agent is there for the last time."""
        return self.begun.removed[0]

    @property
    def num_inserted(self) -> int:
        """Agents that entered at its beginning."""
        if self.ended is None:
            return 0
        return int((self.ended.inserted_number[0] != NO_AGENT).sum())


class World:
    """A session with one rollout, whose ego may be driven: always within a token step."""

    def __init__(self, simulator: Simulator, start: RolloutStart) -> None:
        """Feed the history to the network.

        Raises:
            ValueError: if the scene cannot be simulated.
        """
        self.simulator, self.start = simulator, start
        self._session = Session(simulator, start)
        self._begun: BegunStep | None = None
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
        driven: Float32[np.ndarray, "5 3"] | None = None,
        plan: Float32[np.ndarray, "5 3"] | None = None,
    ) -> WorldStep:
        """End the token step that has begun, and begin the next one.

        Args:
            driven: Where the ego went, if not where it was planned.
            plan: Where it will be next; None lets the network drive it.
        """
        begun_s, session, ended = time.perf_counter(), self._session, None
        if self._begun is not None:
            ended = session.end_step(self._begun, driven)
        self._begun = session.begin_step(plan)
        seconds = time.perf_counter() - begun_s
        return WorldStep(session.token + 1, self._begun, ended, seconds)

    def ids(self, number: Int32[np.ndarray, " agent"]) -> Int32[np.ndarray, " agent"]:
        """Return the track ids of agents by their numbers, as recordings have them."""
        logged = number < self._num_logged
        own = self._track_id[np.where(logged, number, 0)]
        return np.where(logged, own, self._first_id + number).astype(np.int32)
