"""Density control: the number of agents around the ego is held to that at ``now``.

A network with a memory of a few seconds forgets the density. Near the end of a map the
target falls with the length of lanes in reach: the agents would crowd on what is left.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64, Int64

from infgen.rollout.population import EGO_ROW, Population
from infgen.rollout.recording import RolloutStart, number_maps
from infgen.rollout.rules.off_road import lane_segments
from infgen.scene import Scene

Segments = tuple[Float32[np.ndarray, "_ 2"], Float64[np.ndarray, " _"]]

FEWEST_LANES_SHARE = 0.5
"""The target falls below this share of the lane length at ``now``: in logs of towns the
count hardly depends on lane length above it."""


@dataclass(frozen=True, slots=True)
class DensityControl:
    """Number of other agents around each ego of a batch at ``now``.

    Attributes:
        at_now: The numbers.
        lanes_m: Length of the lanes in reach at ``now``.
        segments: Lane segments of each map: first points and lengths.
        scene: Map of each rollout.
        radius_m: Agents nearer to the ego are counted.
    """

    at_now: Int64[np.ndarray, " rollout"]
    lanes_m: Float64[np.ndarray, " rollout"]
    segments: Sequence[Segments]
    scene: Int64[np.ndarray, " rollout"]
    radius_m: float

    @classmethod
    def of(
        cls, starts: Sequence[RolloutStart], population: Population, radius_m: float
    ) -> "DensityControl":
        """Count agents and lanes around the egos at ``now``."""
        maps, scene = number_maps(starts)
        segments = [segments_of(start.scene) for start in maps]
        ego_m = population.pose[:, EGO_ROW, :2]
        lanes_m = _around_m(segments, scene, ego_m, radius_m)
        at_now = population.count_others(radius_m)
        return cls(at_now, lanes_m, segments, scene, radius_m)

    def put(
        self, rollouts: Int64[np.ndarray, " replaced"], others: "DensityControl"
    ) -> "DensityControl":
        """Replace the numbers of some rollouts by those of others."""
        at_now, lanes_m = self.at_now.copy(), self.lanes_m.copy()
        at_now[rollouts], lanes_m[rollouts] = others.at_now, others.lanes_m
        return replace(self, at_now=at_now, lanes_m=lanes_m)

    def wanted(
        self, ego_m: Float32[np.ndarray, "rollout 2"]
    ) -> Float64[np.ndarray, " rollout"]:
        """Return the wanted number of other agents around the egos at their positions."""
        lanes_m = _around_m(self.segments, self.scene, ego_m, self.radius_m)
        enough_m = FEWEST_LANES_SHARE * self.lanes_m
        # On a map without lanes the target does not change.
        share = np.divide(lanes_m, enough_m, np.ones_like(enough_m), where=enough_m > 0)
        return self.at_now * np.minimum(share, 1)


def segments_of(scene: Scene) -> Segments:
    """Return the lane segments of a map."""
    start_m, along_m = lane_segments(scene)
    return start_m[:, :2], np.linalg.norm(along_m, axis=1).astype(np.float64)


def _around_m(
    segments: Sequence[Segments],
    scene: Int64[np.ndarray, " rollout"],
    ego_m: Float32[np.ndarray, "rollout 2"],
    radius_m: float,
) -> Float64[np.ndarray, " rollout"]:
    """Length of the lane segments that begin within a radius of each ego."""
    found = np.zeros(len(scene))
    for at, (start_m, length_m) in enumerate(segments):
        own = np.flatnonzero(scene == at)
        # One axis at a time: sums over a last dimension of two are slow.
        x_m = start_m[:, 0] - ego_m[own, :1]
        y_m = start_m[:, 1] - ego_m[own, 1:]
        near = x_m**2 + y_m**2 < radius_m**2
        found[own] = near @ length_m
    return found
