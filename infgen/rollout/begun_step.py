"""A token step under way: everybody has chosen a motion token, nobody was inserted yet."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int64

from infgen.clock import CLOCK
from infgen.rollout.population import Population, place_logged_agents
from infgen.rollout.recording import NO_AGENT, RolloutStart
from infgen.tokens.scene_tokens import Presence


@dataclass(frozen=True, slots=True)
class BegunStep:
    """A token step of a batch of rollouts whose insertions are still to come.

    Attributes:
        before: Agents at its beginning.
        moved: The same at its end; rows of agents that were removed before are free.
        path: x, y, heading of every row at its five steps.
        shown: At which of them it is observed.
        is_history: Rollouts of whose history it is the last token step: nobody is inserted.
        ego_is_driven: Whether a caller has said where the egos go, or the network chose.
    """

    before: Population
    moved: Population
    path: Float32[np.ndarray, "rollout row 5 3"]
    shown: Bool[np.ndarray, "rollout row 5"]
    is_history: Bool[np.ndarray, " rollout"]
    ego_is_driven: bool

    @property
    def there(self) -> Bool[np.ndarray, "rollout row"]:
        """Rows that hold an agent."""
        return self.moved.agent_number != NO_AGENT

    @property
    def removed(self) -> Bool[np.ndarray, "rollout row"]:
        """Rows whose agent is there for the last time."""
        return self.moved.presence == Presence.REMOVED

    def with_rows(self, rows: int) -> "BegunStep":
        """Append free rows, up to so many."""
        more = ((0, 0), (0, rows - self.path.shape[1]), (0, 0))
        return replace(
            self,
            before=self.before.with_rows(rows),
            moved=self.moved.with_rows(rows),
            path=np.pad(self.path, (*more, (0, 0))),
            shown=np.pad(self.shown, more),
        )

    def put(
        self, rollouts: Int64[np.ndarray, " replaced"], others: "BegunStep"
    ) -> "BegunStep":
        """Replace some rollouts by others, with as many rows."""
        path, shown = self.path.copy(), self.shown.copy()
        is_history = self.is_history.copy()
        path[rollouts], shown[rollouts] = others.path, others.shown
        is_history[rollouts] = others.is_history
        return replace(
            self,
            before=self.before.put(rollouts, others.before),
            moved=self.moved.put(rollouts, others.moved),
            path=path,
            shown=shown,
            is_history=is_history,
        )


def logged_step(starts: Sequence[RolloutStart], min_rows: int) -> BegunStep:
    """Return the last token step of histories, as it was logged.

    Raises:
        ValueError: if a history has no token step before it.
    """
    history = place_logged_agents(starts, min_rows)
    if len(history) < 2:
        raise ValueError(
            f"scene {starts[0].scene.scenario_id} has a history of one token step; "
            "a rollout that takes the place of another needs two, or 1 s"
        )
    before, moved = history[-2:]
    shape = (*moved.agent_number.shape, CLOCK.steps_per_token)
    path, shown = np.zeros((*shape, 3), dtype=np.float32), np.zeros(shape, dtype=bool)
    for at, start in enumerate(starts):
        tracks, end = start.scene.tracks, start.scene.now + 1
        steps = slice(end - CLOCK.steps_per_token, end)
        number = moved.agent_number[at, : start.history.num_agents]
        logged, rows = start.logged_row[number], slice(0, len(number))
        path[at, rows, :, :2] = tracks.xyz_m[logged, steps, :2]
        path[at, rows, :, 2] = tracks.heading_rad[logged, steps]
        shown[at, rows] = tracks.valid[logged, steps]
    is_history = np.ones(len(starts), dtype=bool)
    return BegunStep(before, moved, path, shown, is_history, ego_is_driven=True)
