"""The traffic around the egos of a batch of environments, at 10 Hz.

The network simulates token steps of 0.5 s. At the beginning of one, all agents but the egos
choose their motion tokens; in its five steps they go along the paths of these, and the egos
go where they are driven; at its end agents are inserted, and the network sees what the egos
did. So all environments share one call of the network per token step, and others react to
an ego one token step later.

An environment may begin anew within a token step: that is then the last one of its history,
in which agents go as they were logged.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int64

from infgen.clock import CLOCK
from infgen.rollout.begun_step import BegunStep, logged_step
from infgen.rollout.maps import RolloutMaps
from infgen.rollout.population import EGO_ROW
from infgen.rollout.recording import NO_AGENT, RolloutStart
from infgen.rollout.session import Session
from infgen.rollout.simulator import Simulator


@dataclass(frozen=True, slots=True)
class Agents:
    """All agents of all environments at one 0.1 s step. Row 0 is the ego.

    Attributes:
        pose: x, y, heading in the frame of the scene.
        velocity_mps: Along x and y of that frame; 0 for an agent just inserted.
        there: Rows with an agent that is observed.
        agent_type: ``AgentType``.
        size_lwh_m: Boxes.
    """

    pose: Float32[np.ndarray, "environment row 3"]
    velocity_mps: Float32[np.ndarray, "environment row 2"]
    there: Bool[np.ndarray, "environment row"]
    agent_type: Int8[np.ndarray, "environment row"]
    size_lwh_m: Float32[np.ndarray, "environment row 3"]


class World:
    """A batch of environments that go on together, 0.1 s at a time.

    Attributes:
        agents: All agents now.
        phase: Steps of the token step that have passed, 0 to 4.
        inserted: Agents inserted so far in each environment's episode.
        removed: The same of those removed.
    """

    agents: Agents

    def __init__(
        self, simulator: Simulator, starts: Sequence[RolloutStart], most_maps: int
    ) -> None:
        """Begin all environments at the ends of their histories.

        Args:
            simulator: Network and settings.
            starts: What each environment continues.
            most_maps: Maps to keep encoded.
        """
        self._simulator, self._most_maps = simulator, most_maps
        self._maps = RolloutMaps(simulator, starts)
        self.begin(starts)

    def begin(self, starts: Sequence[RolloutStart]) -> None:
        """Begin all environments anew."""
        self._maps.hold(starts, self._most_maps)
        self._session = Session(self._simulator, starts, self._maps)
        self._begun: BegunStep | None = None
        self.phase = 0
        self.inserted = np.zeros(len(starts), dtype=np.int64)
        self.removed = np.zeros(len(starts), dtype=np.int64)
        step = logged_step(starts, self._session.num_rows)
        self.agents = _agents_at(step, CLOCK.steps_per_token - 1)

    def replace(self, environments: Sequence[int], starts: Sequence[RolloutStart]) -> None:
        """Let some environments begin anew, where the log has them at this step."""
        replaced = self._session.replace(
            self._begin_step(), environments, starts, self._most_maps
        )
        self._begun, at = replaced, list(environments)
        self._driven[at] = replaced.path[at, EGO_ROW]
        self.inserted[at] = self.removed[at] = 0
        if self.phase:
            self.agents = _agents_at(replaced, self.phase - 1)
            self._put_egos()

    def logged_ego(self) -> Float64[np.ndarray, "environment 3"]:
        """Where the egos of replaced environments go in the next step, as logged."""
        begun = self._begin_step()
        return begun.path[:, EGO_ROW, self.phase].astype(np.float64)

    def step(self, ego_pose: Float64[np.ndarray, "environment 3"]) -> None:
        """Go on 0.1 s, the egos to given poses; call ``settle`` before the next step."""
        begun = self._begin_step()
        self._driven[:, self.phase] = ego_pose
        self.agents = _agents_at(begun, self.phase)
        self.phase += 1
        self._put_egos()

    def settle(self) -> None:
        """End the token step if all of its steps have passed: agents are inserted."""
        if self.phase < CLOCK.steps_per_token or self._begun is None:
            return
        frame = self._session.end_step(self._begun, self._driven)
        new = frame.inserted_number != NO_AGENT
        self.inserted += new.sum(axis=1)
        self.removed += frame.removed.sum(axis=1)
        population, now = self._session.population, self.agents
        self.agents = Agents(
            pose=np.where(new[..., None], population.pose, now.pose),
            velocity_mps=np.where(new[..., None], np.float32(0), now.velocity_mps),
            there=now.there | new,
            agent_type=frame.agent_type,
            size_lwh_m=frame.size_lwh_m,
        )
        self._begun, self.phase = None, 0

    @property
    def own_token(self) -> Int64[np.ndarray, " environment"]:
        """Last whole token step of each environment, in its own count."""
        return self._session.own_token

    def _begin_step(self) -> BegunStep:
        """Return the token step under way; the network is called once for each."""
        if self._begun is None:
            self._begun = self._session.begin_step(driven=True)
            shape = (len(self._begun.path), CLOCK.steps_per_token, 3)
            self._driven = np.zeros(shape, dtype=np.float32)
        return self._begun

    def _put_egos(self) -> None:
        """Put the egos where they are driven."""
        self.agents.pose[:, EGO_ROW] = self._driven[:, self.phase - 1]


def _agents_at(step: BegunStep, at: int) -> Agents:
    """Return all agents at one of the five steps of a token step."""
    pose, moved = step.path[:, :, at], step.moved
    there = step.there & step.shown[:, :, at]
    if at:
        before, known = step.path[:, :, at - 1], step.shown[:, :, at - 1]
    else:
        # What was logged before the last token step of a history is not at hand here.
        logged = step.is_history[:, None]
        mirrored = 2 * pose - step.path[:, :, 1]
        before = np.where(logged[..., None], mirrored, step.before.pose)
        known = step.shown[:, :, 1] | ~logged
    velocity_mps = (pose[..., :2] - before[..., :2]) / np.float32(CLOCK.step_s)
    known = known & there
    return Agents(
        pose=pose.copy(),
        velocity_mps=np.where(known[..., None], velocity_mps, np.float32(0)),
        there=there,
        agent_type=moved.agent_type,
        size_lwh_m=moved.size_lwh_m,
    )
