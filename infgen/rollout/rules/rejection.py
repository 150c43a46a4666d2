"""Rejection of motion tokens that lead to a collision or off the road."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float32, Int64

from infgen.clock import CLOCK
from infgen.rollout.population import Population
from infgen.rollout.rules.collision import COMPARED_STEPS, find_collisions, repeat
from infgen.rollout.rules.off_road import RoadEdgeTiles, find_off_road
from infgen.tokens.scene_tokens import Presence
from infgen.tokens.vocabulary import MotionVocabulary

CLEAR_AHEAD = 3
"""Token steps of constant motion that the collision check looks ahead."""
ROAD_AHEAD = (2, 5)
"""The same for the off-road check: least (turns do not last) and most. In between it is the
stopping time of the vehicle ..."""
BRAKES_MPS2 = 4.0
"""... at this deceleration."""


@dataclass(frozen=True, slots=True)
class MotionCheck:
    """Checks motion tokens of a batch of rollouts.

    Attributes:
        vocabulary: Motion tokens.
        road_edge_tiles: Of each map; empty if the off-road check is off.
        scene: Map of each rollout.
    """

    vocabulary: MotionVocabulary
    road_edge_tiles: Sequence[RoadEdgeTiles]
    scene: Int64[np.ndarray, " rollout"]

    def rejects(
        self,
        before: Population,
        motion_token: Int64[np.ndarray, "rollout row"],
        drawn: Bool[np.ndarray, "rollout row"],
        *,
        road: bool,
    ) -> tuple[Bool[np.ndarray, "rollout row"], Bool[np.ndarray, "rollout row"]]:
        """Tell which motion tokens lead to a collision, and which off the road.

        Tokens that stand still are never rejected.

        Args:
            before: All agents at the beginning of the token step.
            motion_token: Motion token of every agent.
            drawn: Rows sampled since the last check: only these are checked for
                off-road, and only pairs with one of them for collisions.
            road: Whether to check for off-road.

        Returns:
            Rows that collide, and rows that leave the road.
        """
        hits, departs = np.zeros_like(drawn), np.zeros_like(drawn)
        some = np.flatnonzero(drawn.any(axis=1))
        if not len(some):
            return hits, departs
        # Few rollouts sample for long, and most rows are free: pairs of rows are expensive.
        few = before.take(some).without_free_rows()
        rows = few.agent_number.shape[1]
        hits[some, :rows], departs[some, :rows] = self._rejects(
            few, motion_token[some, :rows], drawn[some, :rows], self.scene[some], road=road
        )
        return hits, departs

    def _rejects(
        self,
        before: Population,
        motion_token: Int64[np.ndarray, "rollout row"],
        drawn: Bool[np.ndarray, "rollout row"],
        scene: Int64[np.ndarray, " rollout"],
        *,
        road: bool,
    ) -> tuple[Bool[np.ndarray, "rollout row"], Bool[np.ndarray, "rollout row"]]:
        there = (before.presence != Presence.ABSENT) & (before.presence != Presence.REMOVED)
        moving = there & ~self.vocabulary.stationary[before.agent_type, motion_token]
        road = road and bool(self.road_edge_tiles)
        times = max(CLEAR_AHEAD, *ROAD_AHEAD) if road else CLEAR_AHEAD
        poses = repeat(before, motion_token, self.vocabulary, times)
        soon = poses[:, :, : CLEAR_AHEAD * len(COMPARED_STEPS)]
        # Other pairs were checked before: neither of the two has drawn since.
        hits = find_collisions(before, there, soon, drawn) & moving
        if not road:
            return hits, np.zeros_like(hits)
        moments = len(COMPARED_STEPS) * self._look_ahead_tokens(before, motion_token)
        asked = moving & drawn
        return hits, find_off_road(
            before, asked, poses, moments, self.road_edge_tiles, scene
        )

    def is_slower(
        self,
        before: Population,
        motion_token: Int64[np.ndarray, "rollout row"],
        other: Int64[np.ndarray, "rollout row"],
    ) -> Bool[np.ndarray, "rollout row"]:
        """Tell which motion tokens are shorter than others."""
        return self._length_m(before, motion_token) < self._length_m(before, other)

    def is_fast(
        self, before: Population, motion_token: Int64[np.ndarray, "rollout row"]
    ) -> Bool[np.ndarray, "rollout row"]:
        """Tell which vehicles cannot stop within the least look-ahead."""
        return self._look_ahead_tokens(before, motion_token) > ROAD_AHEAD[0]

    def _length_m(
        self, before: Population, motion_token: Int64[np.ndarray, "rollout row"]
    ) -> Float32[np.ndarray, "rollout row"]:
        return _lengths_m(self.vocabulary)[before.agent_type, motion_token]

    def _look_ahead_tokens(
        self, before: Population, motion_token: Int64[np.ndarray, "rollout row"]
    ) -> Int64[np.ndarray, "rollout row"]:
        """Token steps that each vehicle needs to stop, within ``ROAD_AHEAD``."""
        stops_s = self._length_m(before, motion_token) / CLOCK.token_s / (2 * BRAKES_MPS2)
        return np.ceil(stops_s / CLOCK.token_s).clip(*ROAD_AHEAD).astype(np.int64)


@lru_cache(maxsize=8)
def _lengths_m(vocabulary: MotionVocabulary) -> Float32[np.ndarray, "3 motion_token"]:
    return np.linalg.norm(vocabulary.end_pose[..., :2], axis=-1)
