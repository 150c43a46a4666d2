"""Samples of map tokens: what the map vocabulary is made from and measured on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt64

from infgen.scene import Scene
from infgen.tokens.clustering.sample_keys import item_keys, smallest_keys
from infgen.tokens.map import cut_map_tokens


@dataclass(frozen=True, slots=True)
class MapSamples:
    """Pieces of map lines, each in the frame of its own pose.

    Attributes:
        key: Identity of the piece (scene, place in its map), hashed.
        curve_m: Eleven points, evenly spaced along the piece.
    """

    key: UInt64[np.ndarray, " curve"]
    curve_m: Float32[np.ndarray, "curve 11 2"]


NO_MAP_SAMPLES = MapSamples(np.empty(0, np.uint64), np.empty((0, 11, 2), np.float32))


def scene_map_samples(scene: Scene) -> MapSamples:
    """Cut all pieces out of a scene's map."""
    curve_m = cut_map_tokens(scene.road_map).curve_m
    return MapSamples(item_keys(scene.scenario_id, np.arange(len(curve_m))), curve_m)


def merge_map_samples(parts: list[MapSamples], count: int) -> MapSamples:
    """Merge curves and keep at most so many, whatever their order."""
    key = np.concatenate([part.key for part in parts])
    rows = smallest_keys(key, count)
    return MapSamples(key[rows], np.concatenate([part.curve_m for part in parts])[rows])
