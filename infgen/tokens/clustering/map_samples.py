"""Samples of map pieces: what the map codebook is made from and measured on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt64

from infgen.scene import Scene
from infgen.tokens.clustering.sample_keys import item_keys, smallest
from infgen.tokens.map import road_pieces


@dataclass(frozen=True, slots=True)
class Curves:
    """Pieces of map lines, each in the frame of its own pose.

    Attributes:
        key: Identity of the piece (scene, place in its map), hashed.
        curve_m: Eleven points, evenly spaced along the piece.
    """

    key: UInt64[np.ndarray, " curve"]
    curve_m: Float32[np.ndarray, "curve 11 2"]


NO_CURVES = Curves(np.empty(0, np.uint64), np.empty((0, 11, 2), np.float32))


def scene_curves(scene: Scene) -> Curves:
    """Cut all pieces out of a scene's map."""
    curve_m = road_pieces(scene.road_map).curve_m
    return Curves(item_keys(scene.scenario_id, np.arange(len(curve_m))), curve_m)


def sample_curves(parts: list[Curves], count: int) -> Curves:
    """Merge curves and keep at most so many, whatever their order."""
    key = np.concatenate([part.key for part in parts])
    rows = smallest(key, count)
    return Curves(key[rows], np.concatenate([part.curve_m for part in parts])[rows])
