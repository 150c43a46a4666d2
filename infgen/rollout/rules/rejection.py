"""Whose move leads where it should not: into somebody, or off the road."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64

from infgen.clock import CLOCK
from infgen.rollout.population import Population
from infgen.rollout.recording import RolloutStart, number_maps
from infgen.rollout.rules.collision import LOOKED_AT, find_collisions, repeat
from infgen.rollout.rules.off_road import RoadEdgeTiles, find_off_road
from infgen.tokens.scene_tokens import Presence
from infgen.tokens.vocabulary import MotionVocabulary

CLEAR_AHEAD = 3
"""Token steps that everybody is taken to go on alike where it is asked who meets whom."""
ROAD_AHEAD = (2, 5)
"""The same where it is asked who leaves the road: at least, as cars that turn do not turn
for long, and at most. Between these it is as far as a car needs to stop ..."""
BRAKES_MPS2 = 4.0
"""... if it brakes so."""


@dataclass(frozen=True, slots=True)
class MotionCheck:
    """Looks ahead for a batch of rollouts.

    Attributes:
        vocabulary: Moves.
        road_edge_tiles: Of each map; none if nobody is kept on the road.
        scene: Map of each rollout.
    """

    vocabulary: MotionVocabulary
    road_edge_tiles: Sequence[RoadEdgeTiles]
    scene: Int64[np.ndarray, " rollout"]

    def rejects(
        self,
        before: Population,
        move: Int64[np.ndarray, "rollout row"],
        drawn: Bool[np.ndarray, "rollout row"],
        *,
        road: bool,
    ) -> tuple[Bool[np.ndarray, "rollout row"], Bool[np.ndarray, "rollout row"]]:
        """Tell whose move leads into somebody, and whose off the road. Who stands may.

        Args:
            before: Everyone at the beginning of the token step.
            move: Everyone's move.
            drawn: Whose was drawn since it was last asked: nobody else leaves the road,
                and nobody runs into anybody in rollouts that have none.
            road: Whether to ask who leaves the road.
        """
        hits, departs = np.zeros_like(drawn), np.zeros_like(drawn)
        some = np.flatnonzero(drawn.any(axis=1))
        if not len(some):
            return hits, departs
        # A few rollouts draw for long, and most rows are free: pairs of rows are dear.
        few = before.take(some).without_free_rows()
        rows = few.agent_number.shape[1]
        hits[some, :rows], departs[some, :rows] = self._rejects(
            few, move[some, :rows], drawn[some, :rows], self.scene[some], road=road
        )
        return hits, departs

    def _rejects(
        self,
        before: Population,
        move: Int64[np.ndarray, "rollout row"],
        drawn: Bool[np.ndarray, "rollout row"],
        scene: Int64[np.ndarray, " rollout"],
        *,
        road: bool,
    ) -> tuple[Bool[np.ndarray, "rollout row"], Bool[np.ndarray, "rollout row"]]:
        there = (before.presence != Presence.ABSENT) & (before.presence != Presence.REMOVED)
        moving = there & ~self.vocabulary.stationary[before.kind, move]
        road = road and bool(self.road_edge_tiles)
        times = max(CLEAR_AHEAD, *ROAD_AHEAD) if road else CLEAR_AHEAD
        ways = repeat(before, move, self.vocabulary, times)
        soon = ways[:, :, : CLEAR_AHEAD * len(LOOKED_AT)]
        hits = find_collisions(before, there, soon) & moving
        if not road:
            return hits, np.zeros_like(hits)
        moments = len(LOOKED_AT) * self._look_ahead_tokens(before, move)
        asked = moving & drawn
        return hits, find_off_road(
            before, asked, ways, moments, self.road_edge_tiles, scene
        )

    def is_slower(
        self,
        before: Population,
        move: Int64[np.ndarray, "rollout row"],
        other: Int64[np.ndarray, "rollout row"],
    ) -> Bool[np.ndarray, "rollout row"]:
        """Tell whose move is shorter than another."""
        return self._way_m(before, move) < self._way_m(before, other)

    def is_fast(
        self, before: Population, move: Int64[np.ndarray, "rollout row"]
    ) -> Bool[np.ndarray, "rollout row"]:
        """Tell who cannot stop in the time that everybody looks ahead for the road."""
        return self._look_ahead_tokens(before, move) > ROAD_AHEAD[0]

    def _way_m(
        self, before: Population, move: Int64[np.ndarray, "rollout row"]
    ) -> Float32[np.ndarray, "rollout row"]:
        way_m: np.ndarray = self.vocabulary.end_pose[before.kind, move, :2]
        return np.linalg.norm(way_m, axis=-1)

    def _look_ahead_tokens(
        self, before: Population, move: Int64[np.ndarray, "rollout row"]
    ) -> Int64[np.ndarray, "rollout row"]:
        """Token steps of each one's move that it takes as far as it needs to stop."""
        stops_s = self._way_m(before, move) / CLOCK.token_s / (2 * BRAKES_MPS2)
        return np.ceil(stops_s / CLOCK.token_s).clip(*ROAD_AHEAD).astype(np.int64)


def make_motion_check(
    starts: Sequence[RolloutStart], vocabulary: MotionVocabulary, *, reject_off_road: bool
) -> MotionCheck:
    """Look out for rollouts; those of one scene share its map."""
    maps, scene = number_maps(starts)
    road_edge_tiles = (
        [RoadEdgeTiles(start.scene) for start in maps] if reject_off_road else []
    )
    return MotionCheck(vocabulary, road_edge_tiles, scene)
