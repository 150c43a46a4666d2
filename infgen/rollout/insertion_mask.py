"""The insertion mask: positions free of other agents, and near a lane for vehicles.

A position is free if the box overlaps no other box, neither now nor after one more token
step of constant motion. Pedestrians may overlap pedestrians: groups walk closer than their
boxes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int64

from infgen.geometry import boxes_overlap, to_world
from infgen.rollout.population import EGO_ROW, InsertedAgents, Population, insertion_pose
from infgen.scene import AgentType
from infgen.tokens.map import PolylineType
from infgen.tokens.scene_tokens import Presence, SceneTokens
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary

NOWHERE_M = np.float32(1e9)
"""Coordinate of padded lane segments."""


@dataclass(frozen=True, slots=True)
class InsertionMask:
    """Lane segments of the maps of a batch, and what decides whether a position is allowed.

    Attributes:
        start_m: First point of each segment.
        along_m: Vector from there to its last point.
        scene: Map of each rollout.
        lane_m: Greatest distance of a vehicle to a lane, on a map that has lanes.
        end_pose: End pose of each motion token by agent type.
    """

    start_m: Float32[np.ndarray, "scene lane 2"]
    along_m: Float32[np.ndarray, "scene lane 2"]
    scene: Int64[np.ndarray, " rollout"]
    lane_m: float
    end_pose: Float32[np.ndarray, "3 motion_token 3"]

    def take(self, rollouts: Int64[np.ndarray, " kept"]) -> "InsertionMask":
        """Keep some rollouts only."""
        return replace(self, scene=self.scene[rollouts])

    def allows(
        self, population: Population, inserted: InsertedAgents
    ) -> Bool[np.ndarray, " rollout"]:
        """Tell which inserted agents have an allowed position."""
        pose = insertion_pose(population.pose[:, EGO_ROW], inserted)
        pedestrian = inserted.agent_type == AgentType.PEDESTRIAN
        passed = pedestrian[:, None] & (population.agent_type == AgentType.PEDESTRIAN)
        overlaps = np.zeros(len(pose), dtype=bool)
        for everyone in (population.pose, self._soon(population)):
            meets = boxes_overlap(
                pose[:, None],
                inserted.size_lwh_m[:, None, :2],
                everyone,
                population.size_lwh_m[..., :2],
            )
            meets &= (population.presence != Presence.ABSENT) & ~passed
            overlaps |= meets.any(axis=1)
        no_lanes = (self.start_m == NOWHERE_M).all(axis=(1, 2))[self.scene]
        near_lane = self.lane_distance_m(pose[:, :2]) <= self.lane_m
        near_lane |= no_lanes | (inserted.agent_type != AgentType.VEHICLE)
        return near_lane & ~overlaps

    def _soon(self, population: Population) -> Float32[np.ndarray, "rollout row 3"]:
        """Poses one token step ahead if every agent repeats its motion token."""
        moves = population.motion_token >= 0
        motion_token = np.where(moves, population.motion_token, 0)
        step = self.end_pose[population.agent_type, motion_token] * moves[..., None]
        return to_world(step, population.pose)

    def lane_distance_m(
        self, xy_m: Float32[np.ndarray, "rollout 2"]
    ) -> Float32[np.ndarray, " rollout"]:
        """Distance of one point per rollout to the nearest lane of its map."""
        start_m, along_m = self.start_m[self.scene], self.along_m[self.scene]
        away_m = xy_m[:, None] - start_m  # [rollout, lane, 2]
        length2 = np.maximum((along_m**2).sum(axis=-1), np.float32(1e-6))
        share = np.clip((away_m * along_m).sum(axis=-1) / length2, 0, 1)
        gap_m = np.linalg.norm(away_m - share[..., None] * along_m, axis=-1)
        return gap_m.min(axis=1, initial=np.inf)


def make_insertion_mask(
    maps: Sequence[SceneTokens],
    books: tuple[MotionVocabulary, MapVocabulary],
    scene: Int64[np.ndarray, " rollout"],
    lane_m: float,
) -> InsertionMask:
    """Make the insertion mask of some maps; ``scene`` is the map of each rollout."""
    moves, roads = books
    lanes = [_lanes(tokens, roads) for tokens in maps]
    shape = (len(maps), max(len(start_m) for start_m, _ in lanes), 2)
    start_m = np.full(shape, NOWHERE_M)
    along_m = np.zeros(shape, dtype=np.float32)
    for at, (first_m, step_m) in enumerate(lanes):
        start_m[at, : len(first_m)] = first_m
        along_m[at, : len(first_m)] = step_m
    return InsertionMask(start_m, along_m, scene, lane_m, moves.end_pose)


def _lanes(tokens: SceneTokens, roads: MapVocabulary) -> tuple[np.ndarray, np.ndarray]:
    """First points of the lane tokens of a map, and vectors to their last points."""
    rows = tokens.map_polyline_type == PolylineType.LANE
    end_m = roads.curve_m[tokens.map_token[rows], -1]
    end = np.pad(end_m, ((0, 0), (0, 1)))
    pose = tokens.map_pose[rows]
    return pose[:, :2], to_world(end, pose)[:, :2] - pose[:, :2]
