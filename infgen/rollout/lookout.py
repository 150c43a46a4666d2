"""Whose move leads where it should not: into somebody, or off the road."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int64

from infgen.rollout.clearance import LOOKED_AT, find_hits, repeat
from infgen.rollout.kerbs import Kerbs, find_departures
from infgen.rollout.population import Population
from infgen.rollout.trace import Start, number_maps
from infgen.tokens.codebook import MotionCodebook
from infgen.tokens.scene_tokens import Presence

CLEAR_AHEAD = 3
"""Half seconds that everybody is taken to go on alike where it is asked who meets whom."""
ROAD_AHEAD = 2
"""The same where it is asked who leaves the road: cars that turn do not turn for long."""


@dataclass(frozen=True, slots=True)
class Lookout:
    """Looks ahead for a batch of rollouts.

    Attributes:
        codebook: Moves.
        kerbs: Of each map; none if nobody is kept on the road.
        scene: Map of each rollout.
    """

    codebook: MotionCodebook
    kerbs: Sequence[Kerbs]
    scene: Int64[np.ndarray, " rollout"]

    def go_wrong(
        self,
        before: Population,
        move: Int64[np.ndarray, "rollout row"],
        drawn: Bool[np.ndarray, "rollout row"],
        *,
        road: bool,
    ) -> tuple[Bool[np.ndarray, "rollout row"], Bool[np.ndarray, "rollout row"]]:
        """Tell whose move leads into somebody, and whose off the road. Who stands may.

        Args:
            before: Everyone at the beginning of the half second.
            move: Everyone's move.
            drawn: Whose was drawn since it was last asked: nobody else leaves the road.
            road: Whether to ask who leaves the road.
        """
        there = (before.presence != Presence.ABSENT) & (before.presence != Presence.LEAVING)
        moving = there & ~self.codebook.standing[before.kind, move]
        ways = repeat(before, move, self.codebook, CLEAR_AHEAD)
        hits = find_hits(before, there, ways) & moving
        if not road or not self.kerbs:
            return hits, np.zeros_like(hits)
        soon = ways[:, :, : ROAD_AHEAD * len(LOOKED_AT)]
        return hits, find_departures(before, moving & drawn, soon, self.kerbs, self.scene)


def look_out(
    starts: Sequence[Start], codebook: MotionCodebook, *, stay_on_road: bool
) -> Lookout:
    """Look out for rollouts; those of one scene share its map."""
    maps, scene = number_maps(starts)
    kerbs = [Kerbs(start.scene) for start in maps] if stay_on_road else []
    return Lookout(codebook, kerbs, scene)
