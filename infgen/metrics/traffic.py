"""Traffic in one form, logged or simulated, so that the same code measures both."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int64

from infgen.clock import CLOCK
from infgen.metrics.motion import Motion
from infgen.metrics.placement import Events, logged_events, simulated_events
from infgen.rollout.rollout import Rollout
from infgen.rollout.rules.off_road import Lanes
from infgen.scene import AgentType, Scene
from infgen.spatial.lanes import lanes_distance_m
from infgen.tokens.settings import TokenSettings


@dataclass(frozen=True, slots=True)
class Traffic:
    """Vehicles, pedestrians and cyclists of one scene, all its steps.

    Attributes:
        scenario_id: Id of the log.
        index: Which rollout of the scene; ``LOGGED`` for the log itself.
        now: Last step of the history.
        ego: Row of the recording car.
        motion: Their boxes, as one rollout, in the scene's frame.
        events: Entries and exits after now.
    """

    scenario_id: str
    index: int
    now: int
    ego: int
    motion: Motion
    events: Events

    @property
    def future(self) -> slice:
        """Steps after now."""
        return slice(self.now + 1, self.motion.x_m.shape[2])

    @property
    def future_tokens(self) -> int:
        """Whole token steps after now."""
        return (self.motion.x_m.shape[2] - 1 - self.now) // CLOCK.steps_per_token

    @property
    def there_now(self) -> Bool[np.ndarray, " agent"]:
        """Agents present at the last step of the history."""
        return self.motion.valid[0, :, self.now]


OFF_MAP_M = 30.0
"""An ego so far from every lane has left the map."""
OF_STEPS = ("x_m", "y_m", "z_m", "heading_rad", "valid")
"""What of a motion is by step."""
LOGGED = -1
"""Index of the log among the rollouts of its scene."""


def from_log(scene: Scene, settings: TokenSettings) -> Traffic:
    """Read a log. Boxes are the mean of their observed steps.

    Raises:
        TokensError: if the log cannot be written as tokens.
    """
    events = logged_events(scene, settings)
    return replace(observe_log(scene), events=events)


def logged_rows(scene: Scene) -> Int64[np.ndarray, " agent"]:
    """Rows of the tracks that are vehicles, pedestrians and cyclists."""
    agent_type = scene.tracks.agent_type
    return np.flatnonzero((agent_type >= 0) & (agent_type < AgentType.OTHER))


def observe_log(scene: Scene) -> Traffic:
    """Read a log without its entries and exits, which are read from tokens."""
    tracks, rows = scene.tracks, logged_rows(scene)
    valid = tracks.valid[rows]
    share = valid / np.maximum(1, valid.sum(axis=1, keepdims=True))
    size_lwh_m = np.einsum("as,asc->ac", share, tracks.size_lwh_m[rows])
    xyz_m = np.ascontiguousarray(np.moveaxis(tracks.xyz_m[rows], -1, 0))
    nothing = np.zeros(0, np.int16), np.zeros(0, np.float32)
    return Traffic(
        scenario_id=scene.scenario_id,
        index=LOGGED,
        now=scene.now,
        ego=int(np.flatnonzero(rows == scene.ego)[0]),
        motion=Motion(
            x_m=xyz_m[None, 0],
            y_m=xyz_m[None, 1],
            z_m=xyz_m[None, 2],
            heading_rad=tracks.heading_rad[None, rows],
            size_lwh_m=size_lwh_m.astype(np.float32),
            agent_type=tracks.agent_type[rows],
            valid=valid[None],
        ),
        events=Events(*nothing, *nothing),
    )


def from_rollout(rollout: Rollout) -> Traffic:
    """Read a rollout."""
    xyz_m = np.ascontiguousarray(np.moveaxis(rollout.xyz_m, -1, 0))
    return Traffic(
        scenario_id=rollout.scenario_id,
        index=rollout.index,
        now=rollout.now,
        ego=rollout.ego,
        motion=Motion(
            x_m=xyz_m[None, 0],
            y_m=xyz_m[None, 1],
            z_m=xyz_m[None, 2],
            heading_rad=rollout.heading_rad[None],
            size_lwh_m=rollout.size_lwh_m,
            agent_type=rollout.agent_type,
            valid=rollout.valid[None],
        ),
        events=simulated_events(rollout),
    )


def on_map(traffic: Traffic, lanes: Lanes) -> Traffic:
    """Cut a log or rollout where its ego leaves the map, if it does: none enters there.

    Maps of WOMD end where its ego did not get in nine seconds; a rollout gets farther.

    Args:
        traffic: With its events, those of what is cut off too.
        lanes: All lanes of the map; without any the ego never leaves the map.
    """
    motion = traffic.motion
    x_m, y_m = motion.x_m[0, traffic.ego], motion.y_m[0, traffic.ego]
    steps = np.arange(traffic.now + 1, len(x_m), CLOCK.steps_per_token)
    ego_m = np.column_stack([x_m[steps], y_m[steps], 0 * steps]).astype(np.float32)
    (off,) = np.nonzero(lanes_distance_m(ego_m, *lanes) > OFF_MAP_M)
    if not len(off) or not len(lanes[0]):
        return traffic
    end = int(steps[off[0]])
    cut = {name: getattr(motion, name)[..., :end] for name in OF_STEPS}
    return replace(traffic, motion=replace(motion, **cut))


def with_boxes(traffic: Traffic, size_lwh_m: np.ndarray) -> Traffic:
    """Give the agents other boxes."""
    return replace(traffic, motion=replace(traffic.motion, size_lwh_m=size_lwh_m))
