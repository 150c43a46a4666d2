"""What there is to see of a scene: its map, its lights, and each played or logged future.

Player, video and strips draw the same ``ViewModel``. Positions are in the scene's local
frame.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int16, Int32

from infgen.rollout.rollout import Rollout
from infgen.scene import Scene
from infgen.views.scene.drawn_map import DrawnMap, Lights, draw_map, find_lights

LOG = "log"


class Role(IntEnum):
    """How an agent came to be there."""

    EGO = 0
    INITIAL = 1
    INSERTED = 2


@dataclass(frozen=True, slots=True)
class Showing:
    """One past and future: the log, or a rollout that goes on from it.

    Attributes:
        name: ``log``, or ``rollout 3``.
        ego: Row of the recording car.
        id: Track ids.
        agent_type: ``AgentType``.
        role: ``Role``; in the log ``INSERTED`` are those first seen after now.
        size_lw_m: One box per agent.
        pose: x, y, heading; where ``valid`` is False it means nothing.
        valid: Whether the agent is there at that step.
        last_step: Last step of an agent that left before the end, else the number of steps.
    """

    name: str
    ego: int
    id: Int32[np.ndarray, " agent"]
    agent_type: Int8[np.ndarray, " agent"]
    role: Int8[np.ndarray, " agent"]
    size_lw_m: Float32[np.ndarray, "agent 2"]
    pose: Float32[np.ndarray, "agent step 3"]
    valid: Bool[np.ndarray, "agent step"]
    last_step: Int16[np.ndarray, " agent"]

    @property
    def num_steps(self) -> int:
        """Number of 0.1 s steps, history included."""
        return int(self.valid.shape[1])

    @property
    def first_step(self) -> Int16[np.ndarray, " agent"]:
        """First step of each agent."""
        return self.valid.argmax(axis=1).astype(np.int16)


@dataclass(frozen=True, slots=True)
class ViewModel:
    """A scene and what is shown of it.

    Attributes:
        scenario_id: Id of the log.
        now: Last step of the history.
        weights: Fingerprint of the weights that played the rollouts; empty without any.
        drawn_map: The map.
        lights: Traffic lights.
        showings: The log, rollouts, or both; at least one.
    """

    scenario_id: str
    now: int
    weights: str
    drawn_map: DrawnMap
    lights: Lights
    showings: tuple[Showing, ...]

    def __post_init__(self) -> None:
        """Refuse a film without a picture.

        Raises:
            ValueError: if there is nothing to show.
        """
        if not self.showings:
            raise ValueError(f"nothing to show of scene {self.scenario_id}")

    @property
    def num_steps(self) -> int:
        """Steps of the longest showing."""
        return max(showing.num_steps for showing in self.showings)


def make_view_model(
    scene: Scene, rollouts: tuple[Rollout, ...], *, log: bool = True
) -> ViewModel:
    """Gather what is shown of a scene.

    Raises:
        ValueError: if a rollout is of another scene, or there is nothing to show.
    """
    for rollout in rollouts:
        if rollout.scenario_id != scene.scenario_id:
            raise ValueError(
                f"rollout {rollout.index} is of scene {rollout.scenario_id}, "
                f"not of {scene.scenario_id}"
            )
    logged = (show_log(scene),) if log else ()
    return ViewModel(
        scenario_id=scene.scenario_id,
        now=scene.now,
        weights=rollouts[0].weights if rollouts else "",
        drawn_map=draw_map(scene.road_map),
        lights=find_lights(scene),
        showings=(*logged, *map(show_rollout, rollouts)),
    )


def show_log(scene: Scene) -> Showing:
    """Show a log; boxes have the mean of their sizes."""
    tracks = scene.tracks
    valid = tracks.valid
    role = np.where(valid[:, : scene.now + 1].any(axis=1), Role.INITIAL, Role.INSERTED)
    seen = np.maximum(1, valid.sum(axis=1))[:, None]
    size = (tracks.size_lwh_m[..., :2] * valid[..., None]).sum(axis=1) / seen
    pose = np.concatenate([tracks.xyz_m[..., :2], tracks.heading_rad[..., None]], axis=-1)
    return _showing(
        LOG,
        scene.ego,
        tracks.id,
        tracks.agent_type,
        role,
        size.astype(np.float32),
        pose,
        valid,
    )


def show_rollout(rollout: Rollout) -> Showing:
    """Show a rollout."""
    pose = np.concatenate([rollout.xyz_m[..., :2], rollout.heading_rad[..., None]], axis=-1)
    role = np.where(rollout.logged, Role.INITIAL, Role.INSERTED)
    return _showing(
        f"rollout {rollout.index}",
        rollout.ego,
        rollout.id,
        rollout.agent_type,
        role,
        rollout.size_lwh_m[:, :2],
        pose,
        rollout.valid,
    )


def _showing(
    name: str,
    ego: int,
    id_: np.ndarray,
    agent_type: np.ndarray,
    role: np.ndarray,
    size_lw_m: np.ndarray,
    pose: np.ndarray,
    valid: np.ndarray,
) -> Showing:
    """Leave out who is never there."""
    rows = np.flatnonzero(valid.any(axis=1) | (np.arange(len(id_)) == ego))
    steps = valid.shape[1]
    last = steps - 1 - valid[rows, ::-1].argmax(axis=1)
    role = role.astype(np.int8)
    role[ego] = Role.EGO
    return Showing(
        name=name,
        ego=int(np.searchsorted(rows, ego)),
        id=id_[rows],
        agent_type=agent_type[rows],
        role=role[rows],
        size_lw_m=size_lw_m[rows],
        pose=pose[rows],
        valid=valid[rows],
        last_step=np.where(last < steps - 1, last, steps).astype(np.int16),
    )
