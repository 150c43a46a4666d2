"""How full the street around an ego is to be: as full as it was at now.

A network that looks back for a few seconds forgets how many there were. Where a map ends
there are not to be as many: they would all stand on what is left of it, or beyond.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from infgen.rollout.population import EGO_ROW, Population
from infgen.rollout.recording import RolloutStart, number_maps
from infgen.rollout.rules.off_road import lane_segments
from infgen.scene import Scene

Pieces = tuple[Float32[np.ndarray, "_ 2"], Float64[np.ndarray, " _"]]

FEWEST_LANES_SHARE = 0.5
"""With this share of the lanes that were around at now, a street is as full as then: counts
in towns' logs hardly depend on how much road there is, as long as there is some."""


@dataclass(frozen=True, slots=True)
class DensityControl:
    """How many others there were around each ego of a batch of rollouts.

    Attributes:
        at_now: How many.
        lanes_m: Length of the lanes there.
        pieces: Of the lanes of each map: where each begins, and its length.
        scene: Map of each rollout.
        radius_m: Whoever is nearer to the ego is around it.
    """

    at_now: Int64[np.ndarray, " rollout"]
    lanes_m: Float64[np.ndarray, " rollout"]
    pieces: Sequence[Pieces]
    scene: Int64[np.ndarray, " rollout"]
    radius_m: float

    @classmethod
    def of(
        cls, starts: Sequence[RolloutStart], population: Population, radius_m: float
    ) -> "DensityControl":
        """Look around the egos at now."""
        maps, scene = number_maps(starts)
        pieces = [pieces_of(start.scene) for start in maps]
        ego_m = population.pose[:, EGO_ROW, :2]
        lanes_m = _around_m(pieces, scene, ego_m, radius_m)
        at_now = population.count_others(radius_m)
        return cls(at_now, lanes_m, pieces, scene, radius_m)

    def wanted(
        self, ego_m: Float32[np.ndarray, "rollout 2"]
    ) -> Float64[np.ndarray, " rollout"]:
        """How many others are to be around the egos where they are."""
        lanes_m = _around_m(self.pieces, self.scene, ego_m, self.radius_m)
        enough_m = FEWEST_LANES_SHARE * self.lanes_m
        # A map without lanes is everywhere as it was.
        share = np.divide(lanes_m, enough_m, np.ones_like(enough_m), where=enough_m > 0)
        return self.at_now * np.minimum(share, 1)


def pieces_of(scene: Scene) -> Pieces:
    """Take the pieces of a map's lanes."""
    start_m, along_m = lane_segments(scene)
    return start_m[:, :2], np.linalg.norm(along_m, axis=1).astype(np.float64)


def _around_m(
    pieces: Sequence[Pieces],
    scene: Int64[np.ndarray, " rollout"],
    ego_m: Float32[np.ndarray, "rollout 2"],
    radius_m: float,
) -> Float64[np.ndarray, " rollout"]:
    """Length of the pieces of lanes that begin within a radius of each ego."""
    found = np.zeros(len(scene))
    for at, (start_m, length_m) in enumerate(pieces):
        own = np.flatnonzero(scene == at)
        away_m = start_m - ego_m[own, None]
        near = (away_m**2).sum(axis=-1) < radius_m**2
        found[own] = near @ length_m
    return found
