"""The insertion mask: positions free of other agents, and near a lane for vehicles.

A position is free if the box overlaps no other box, neither now nor after one more token
step of constant motion. Pedestrians may overlap pedestrians: groups walk closer than their
boxes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64

from infgen.geometry import boxes_overlap, to_world
from infgen.rollout.lane_squares import Lanes, LaneSquares, lane_gap_m
from infgen.rollout.population import EGO_ROW, InsertedAgents, Population, insertion_pose
from infgen.scene import AgentType
from infgen.tokens.map import PolylineType
from infgen.tokens.scene_tokens import Presence, SceneTokens
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary

MARGIN_M = 0.1
"""Boxes whose circles are farther apart do not overlap, whatever rounding does."""


@dataclass(frozen=True, slots=True)
class InsertionMask:
    """Lane segments of the maps of a batch, and what decides whether a position is allowed.

    Attributes:
        lanes: Lane segments of each map.
        squares: The same by where they are.
        scene: Map of each rollout.
        end_pose: End pose of each motion token by agent type ...
        length_m: ... and how far away it is.
    """

    lanes: Sequence[Lanes]
    squares: LaneSquares
    scene: Int64[np.ndarray, " rollout"]
    end_pose: Float32[np.ndarray, "3 motion_token 3"]
    length_m: Float32[np.ndarray, "3 motion_token"]

    def allows(
        self,
        population: Population,
        inserted: InsertedAgents,
        rollouts: Int64[np.ndarray, " inserted"] | None = None,
    ) -> Bool[np.ndarray, " inserted"]:
        """Tell which inserted agents have an allowed position.

        Args:
            population: All agents of all rollouts.
            inserted: Agents to insert.
            rollouts: Where to insert them; one into each rollout if None.
        """
        rollouts = np.arange(len(self.scene)) if rollouts is None else rollouts
        pose = insertion_pose(population.pose[rollouts, EGO_ROW], inserted)
        allowed = ~self._overlaps(population.without_free_rows(), inserted, rollouts, pose)
        vehicle = inserted.agent_type == AgentType.VEHICLE
        asked = np.flatnonzero(allowed & vehicle & self._has_lanes()[self.scene[rollouts]])
        allowed[asked] = self.squares.has_lane(pose[asked, :2], self.scene[rollouts[asked]])
        return allowed

    def _has_lanes(self) -> Bool[np.ndarray, " scene"]:
        return np.array([len(start_m) > 0 for start_m, _ in self.lanes])

    def _overlaps(
        self,
        population: Population,
        inserted: InsertedAgents,
        rollouts: Int64[np.ndarray, " inserted"],
        pose: Float32[np.ndarray, "inserted 3"],
    ) -> Bool[np.ndarray, " inserted"]:
        """Tell which boxes overlap another one, now or one token step ahead."""
        moves = population.motion_token[rollouts] >= 0
        motion_token = np.where(moves, population.motion_token[rollouts], 0)
        agent_type = population.agent_type[rollouts]
        size_m = population.size_lwh_m[rollouts]
        # Only boxes whose circles meet, a token step of motion included, are looked at.
        reach_m = np.hypot(size_m[..., 0], size_m[..., 1]) / 2 + MARGIN_M
        reach_m += self.length_m[agent_type, motion_token] * moves
        reach_m += np.hypot(*inserted.size_lwh_m[:, :2].T)[:, None] / 2
        there = population.pose[rollouts]
        x_m, y_m = there[..., 0] - pose[:, :1], there[..., 1] - pose[:, 1:2]
        near = x_m * x_m + y_m * y_m < reach_m * reach_m
        near &= population.presence[rollouts] != Presence.ABSENT
        pedestrian = (inserted.agent_type == AgentType.PEDESTRIAN)[:, None]
        near &= ~(pedestrian & (agent_type == AgentType.PEDESTRIAN))
        who, row = np.nonzero(near)

        step = self.end_pose[agent_type[who, row], motion_token[who, row]]
        step = step * moves[who, row, None]
        meets = np.zeros(len(who), dtype=bool)
        for everyone in (there[who, row], to_world(step, there[who, row])):
            meets |= boxes_overlap(
                pose[who],
                inserted.size_lwh_m[who, :2],
                everyone,
                size_m[who, row, :2],
            )
        overlaps = np.zeros(len(pose), dtype=bool)
        overlaps[who[meets]] = True
        return overlaps

    def lane_distance_m(
        self, xy_m: Float32[np.ndarray, "rollout 2"]
    ) -> Float32[np.ndarray, " rollout"]:
        """Distance of one point per rollout to the nearest lane of its map."""
        nearest_m = [
            lane_gap_m(point_m, *self.lanes[at]).min(initial=np.inf)
            for point_m, at in zip(xy_m, self.scene, strict=True)
        ]
        return np.array(nearest_m, dtype=np.float32)


def make_insertion_mask(
    maps: Sequence[SceneTokens],
    books: tuple[MotionVocabulary, MapVocabulary],
    scene: Int64[np.ndarray, " rollout"],
    lane_m: float,
) -> InsertionMask:
    """Make the insertion mask of some maps.

    Args:
        maps: Tokens of the maps.
        books: Motion tokens and map tokens.
        scene: Map of each rollout.
        lane_m: Greatest distance of a vehicle to a lane, on a map that has lanes.
    """
    moves, roads = books
    lanes = [_lanes(tokens, roads) for tokens in maps]
    length_m = np.hypot(moves.end_pose[..., 0], moves.end_pose[..., 1])
    return InsertionMask(
        lanes, LaneSquares.of(lanes, lane_m), scene, moves.end_pose, length_m
    )


def _lanes(tokens: SceneTokens, roads: MapVocabulary) -> Lanes:
    """First points of the lane tokens of a map, and vectors to their last points."""
    rows = tokens.map_polyline_type == PolylineType.LANE
    end_m = roads.curve_m[tokens.map_token[rows], -1]
    end = np.pad(end_m, ((0, 0), (0, 1)))
    pose = tokens.map_pose[rows]
    return pose[:, :2], to_world(end, pose)[:, :2] - pose[:, :2]
