"""Settings of the environment: keywords of ``gymnasium.make("infgen/Drive-v0", ...)``."""

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from infgen.clock import CLOCK
from infgen.rollout.settings import RuleName
from infgen.settings import RULES, AtLeastOne, NonNegative, Positive

Hertz = Literal[10, 2]
Places = Annotated[AtLeastOne, Field(le=256)]


@dataclass(frozen=True, slots=True, config=RULES)
class EnvironmentSettings:
    """What an agent decides, what it sees, and when its episode ends."""

    action: Literal["bicycle", "waypoint"] = "bicycle"
    """`bicycle` for acceleration and steering angle of a kinematic bicycle, `waypoint` for
    the pose at the end of the step."""
    observation: Literal["dict", "flat"] = "dict"
    """`dict` for named arrays, `flat` for all of them in one vector."""
    hz: Hertz = 10
    """Steps per second. The network simulates token steps of 0.5 s: at 10 Hz an action is
    taken at each of their five steps, at 2 Hz once."""
    rules: RuleName | None = None
    """Rules over the choices of the network that drives all others: `none` or `safe`, as in
    `rollout.rules`. If not set, those of `simulator`; of the package's simulator `safe`."""
    max_seconds: Positive = 300.0
    """An episode is truncated after so long."""
    off_road_m: NonNegative = 0.0
    """An episode ends when a corner of the ego's box is farther than this off the road."""
    route_length_m: Positive = 2000.0
    """Longest route; it ends earlier where the lanes of the map end. At its end an episode
    is truncated."""
    radius_m: Positive = 75.0
    """Agents, map tokens and signals within this distance of the ego are observed."""
    num_agents: Places = 16
    """Agents that are observed, the nearest ones."""
    num_map_tokens: Places = 64
    """The same for map tokens."""
    num_signals: Places = 4
    """The same for stop lines of traffic signals."""
    num_route_points: Places = 10
    """Points of the route ahead that are observed, 5 m apart."""

    @property
    def steps_per_action(self) -> int:
        """Steps of 0.1 s that an action lasts."""
        return round(1 / (CLOCK.step_s * self.hz))

    @property
    def action_s(self) -> float:
        """Seconds that an action lasts."""
        return CLOCK.step_s * self.steps_per_action
