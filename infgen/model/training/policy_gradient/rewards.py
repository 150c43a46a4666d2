"""Realism of simulated rollouts, agent by agent and token step by token step.

Five terms, all of them costs, each at the token step at the end of which it is seen:

- *overlap*: the agent runs into another one (or is inserted into it);
- *off-road*: a vehicle leaves the road, or gets farther off it;
- *log distance*: how far from the log's distribution of positions the agent is;
- *placement*: how far from the log's distribution, off the road or on it, it is inserted;
- *speed*: how far from the log's distribution of speeds it drives.

The first two are events, counted once. The others are gradients of an energy score
(Gneiting and Raftery 2007), which is best for the true distribution. The log distance is
the square root of the distance to the logged position, less that to the other rollouts'
positions. Without the second part all rollouts would be drawn to one path.

What the type of an inserted agent costs, and the number of agents, stands beside them, for
it is not in the reward of an agent.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from infgen.geometry import boxes_overlap, to_local, to_world
from infgen.model.batching.batch import Agents
from infgen.model.training.policy_gradient.energy import energy_by_agent
from infgen.model.training.policy_gradient.placement import placement_costs
from infgen.model.training.policy_gradient.population import count_costs
from infgen.model.training.policy_gradient.road import Road
from infgen.model.training.policy_gradient.rollouts import SimulatedRollouts
from infgen.model.training.policy_gradient.speeds import speed_costs
from infgen.model.training.policy_gradient.types import type_costs
from infgen.model.training_settings import TrainSettings
from infgen.scene import AgentType
from infgen.spatial.road_edges import leaves_road
from infgen.tokens.scene_tokens import EGO
from infgen.tokens.vocabulary import MotionVocabulary

MIDDLE_STEP = 3
"""Step of a token step at which boxes are compared, besides its end."""
NEAR_M = 8.0
"""Boxes farther apart than this at the end of a token step did not overlap in it: from its
middle on they part by no more, at up to 40 m/s."""


@dataclass(frozen=True, slots=True)
class Costs:
    """What is not realistic, of every agent at every token step; zero where it is absent.

    Attributes:
        overlap: Whether it runs into another agent.
        off_road: Whether it leaves the road.
        log_distance: Its log distance, in square roots of metres.
        energy_score: The energy score that it is a part of, in the same unit.
        placement: Placement cost of an inserted vehicle, in metres.
        speed: Speed cost of a vehicle, in m/s.
        agent_type: Cost of the type of an inserted agent.
        count: Count cost of the whole rollout.
    """

    overlap: Bool[Tensor, "rollout token agent"]
    off_road: Bool[Tensor, "rollout token agent"]
    log_distance: Float32[Tensor, "rollout token agent"]
    energy_score: Float32[Tensor, "rollout token agent"]
    placement: Float32[Tensor, "rollout token agent"]
    speed: Float32[Tensor, "rollout token agent"]
    agent_type: Float32[Tensor, "rollout token agent"]
    count: Float32[Tensor, "rollout token"]

    def reward(self, settings: TrainSettings) -> Float32[Tensor, "rollout token agent"]:
        """Weigh the costs of an agent but that of its type."""
        speed = settings.speed_penalty * self.speed
        speed[..., EGO] = settings.ego_speed_penalty * self.speed[..., EGO]
        return -(
            settings.overlap_penalty * self.overlap.float()
            + settings.off_road_penalty * self.off_road.float()
            + settings.log_distance_penalty * self.log_distance
            + settings.placement_penalty * self.placement
            + speed
        )


def find_costs(
    rollouts: SimulatedRollouts, vocabulary: MotionVocabulary, roads: list[Road]
) -> Costs:
    """Find all costs, on the host but for the log distance.

    Args:
        rollouts: Simulated agents.
        vocabulary: Of their motion tokens.
        roads: Of every scene.
    """
    seen, device = SeenAgents.of(rollouts), rollouts.moved.device
    return Costs(
        torch.from_numpy(find_overlaps(seen, vocabulary)).to(device),
        torch.from_numpy(find_off_road(seen, roads)).to(device),
        *log_distance(rollouts),
        torch.from_numpy(placement_costs(rollouts, roads)).to(device),
        speed_costs(rollouts),
        type_costs(rollouts),
        count_costs(rollouts),
    )


@dataclass(frozen=True, slots=True)
class SeenAgents:
    """Simulated agents on the host, as ``Agents`` and ``SimulatedRollouts`` have them."""

    pose: Float32[np.ndarray, "rollout token agent 3"]
    size_lw_m: Float32[np.ndarray, "rollout agent 2"]
    agent_type: np.ndarray
    motion_token: np.ndarray
    turn: np.ndarray
    moved: Bool[np.ndarray, "rollout token agent"]
    inserted: Bool[np.ndarray, "rollout token agent"]

    @classmethod
    def of(cls, rollouts: SimulatedRollouts) -> "SeenAgents":
        """Bring the agents of rollouts to the host."""
        agents: Agents = rollouts.batch.agents
        return cls(
            *(
                each.numpy(force=True)
                for each in (
                    agents.pose,
                    agents.size_lwh_m[..., :2],
                    agents.agent_type,
                    agents.motion_token,
                    agents.turn,
                    rollouts.moved,
                    rollouts.inserted,
                )
            )
        )


def find_overlaps(
    seen: SeenAgents, vocabulary: MotionVocabulary
) -> Bool[np.ndarray, "rollout token agent"]:
    """Tell who comes to overlap another agent, at the middle or the end of a token step.

    Of two boxes that come to overlap by moving, the one that has the centre of the other
    ahead pays; of an inserted agent and one that was there, or of two inserted ones, the
    one inserted last. Two pedestrians do not: groups walk closer than their boxes.
    """
    pays = np.zeros(seen.moved.shape, dtype=bool)
    for token in range(1, seen.pose.shape[1]):
        there = seen.moved[:, token] | seen.inserted[:, token]
        rollout, one, two = _near_pairs(seen, token, there)
        some = _begin_to_overlap(seen, token, (rollout, one, two), vocabulary)
        rollout, one, two = rollout[some], one[some], two[some]
        came_one, came_two = (_came(seen, token, rollout, row) for row in (one, two))
        for own, other, came, others in (
            (one, two, came_one, came_two),
            (two, one, came_two, came_one),
        ):
            before = seen.pose[rollout, token - 1]
            each = np.arange(len(rollout))
            ahead = to_local(before[each, other], before[each, own])[:, 0] > 0
            moved = (came < 0) & (others < 0)
            blamed = np.where(moved, ahead, came > others)
            pays[rollout[blamed], token, own[blamed]] = True
    return pays


def _came(seen: SeenAgents, token: int, rollout: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Insertion turns at a token step; -1 of agents that were there before."""
    turn = seen.turn[rollout, token, row]
    return np.where(seen.inserted[rollout, token, row], turn, -1)


def _near_pairs(
    seen: SeenAgents, token: int, there: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs that may overlap, each once: rollout, lower row, higher row."""
    pose, reach_m = seen.pose[:, token], np.hypot(*np.moveaxis(seen.size_lw_m, -1, 0)) / 2
    x_m, y_m = pose[..., 0], pose[..., 1]
    away_x_m = x_m[:, :, None] - x_m[:, None]
    away_y_m = y_m[:, :, None] - y_m[:, None]
    wide_m = reach_m[:, :, None] + reach_m[:, None] + NEAR_M
    near = away_x_m * away_x_m + away_y_m * away_y_m < wide_m * wide_m
    walks = seen.agent_type == AgentType.PEDESTRIAN
    near &= there[:, :, None] & there[:, None] & ~(walks[:, :, None] & walks[:, None])
    rollout, one, two = np.nonzero(np.triu(near, 1))
    return rollout, one, two


def _begin_to_overlap(
    seen: SeenAgents,
    token: int,
    pairs: tuple[np.ndarray, np.ndarray, np.ndarray],
    vocabulary: MotionVocabulary,
) -> Bool[np.ndarray, " pair"]:
    """Tell which pairs overlap in a token step and did not at its beginning."""
    rollout, *rows = pairs
    sizes = [seen.size_lw_m[rollout, row] for row in rows]

    def overlap(poses: list[np.ndarray]) -> np.ndarray:
        return boxes_overlap(poses[0], sizes[0], poses[1], sizes[1])

    moved = seen.moved[rollout, token, rows[0]] & seen.moved[rollout, token, rows[1]]
    before = [seen.pose[rollout, token - 1, row] for row in rows]
    path = [
        vocabulary.path[
            seen.agent_type[rollout, row],
            np.maximum(seen.motion_token[rollout, token, row], 0),
            MIDDLE_STEP,
        ]
        for row in rows
    ]
    middle = [to_world(way, pose) for way, pose in zip(path, before, strict=True)]
    end = overlap([seen.pose[rollout, token, row] for row in rows])
    return np.where(moved, (end | overlap(middle)) & ~overlap(before), end)


def find_off_road(
    seen: SeenAgents, roads: list[Road]
) -> Bool[np.ndarray, "rollout token agent"]:
    """Tell which vehicles leave the road, or get farther off it, in a token step."""
    moved = seen.moved & (seen.agent_type == AgentType.VEHICLE)[:, None]
    wanted = moved.copy()
    wanted[:, :-1] |= moved[:, 1:]
    off_m = np.full(moved.shape, -np.inf, dtype=np.float32)
    scene = np.arange(len(moved)) % len(roads)
    for number, road in enumerate(roads):
        at = np.nonzero(wanted & (scene == number)[:, None, None])
        off_m[at] = road.off_m(seen.pose[at], seen.size_lw_m[at[0], at[2]])
    departs = np.zeros_like(moved)
    departs[:, 1:] = moved[:, 1:] & leaves_road(off_m[:, :-1], off_m[:, 1:])
    return departs


def log_distance(rollouts: SimulatedRollouts) -> tuple[Tensor, Tensor]:
    """Compare the positions of rollouts with those of the log, and with each other.

    Of the agents that the log and the rollouts have.

    Returns:
        Costs, and energy scores, whose mean they lower [rollout, token, agent].
    """
    counts = rollouts.moved & rollouts.known[:, None] & rollouts.logged.observed
    xy_m, logged_xy_m = (
        agents.pose[..., :2] for agents in (rollouts.batch.agents, rollouts.logged)
    )
    return energy_by_agent(xy_m, logged_xy_m, counts, rollouts.count, _root_distance)


def _root_distance(xy_m: Tensor, other_m: Tensor) -> Tensor:
    return (xy_m - other_m).norm(dim=-1).sqrt()
