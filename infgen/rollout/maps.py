"""The maps that a batch of rollouts is on: each is encoded once, however often it is used.

Rollouts may take the place of others while a batch runs, on maps that nobody was on before.
So the encoded maps, and what rules know of each, are kept by scene and put side by side
again when a map is added.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from infgen.clock import CLOCK
from infgen.model.batching.batch import MapTokens, collate_maps, to_device
from infgen.model.features.signals import StopLines
from infgen.model.neighbours import MapFeatures
from infgen.rollout.recording import RolloutStart
from infgen.rollout.rules.density import DensityControl, Segments, segments_of
from infgen.rollout.rules.insertion_mask import InsertionMask, make_insertion_mask
from infgen.rollout.rules.off_road import RoadEdgeTiles
from infgen.rollout.rules.rejection import MotionCheck
from infgen.rollout.rules.stalls import StallRule
from infgen.rollout.simulator import Simulator

Scenes = Int64[np.ndarray, " rollout"]


class RolloutMaps:
    """Maps side by side, and what rules know of them.

    Attributes:
        features: The encoded maps.
    """

    features: MapFeatures

    def __init__(self, simulator: Simulator, starts: Sequence[RolloutStart]) -> None:
        """Encode the maps of some rollouts, all at once."""
        self._simulator = simulator
        # By the ``id`` of a scene, which is held: a user may have changed one and kept its
        # scenario id.
        self._held: dict[int, RolloutStart] = {}
        self._encoded: dict[int, Tensor] = {}
        self._tiles: dict[int, RoadEdgeTiles] = {}
        self._segments: list[Segments] | None = None
        self._mask: InsertionMask | None = None
        self._stalls: StallRule | None = None
        self.hold(starts, len(starts))

    def hold(self, starts: Sequence[RolloutStart], most: int) -> None:
        """Hold the maps of all running rollouts, and of earlier ones while there is room.

        Args:
            starts: What all rollouts of the batch continue.
            most: Number of maps beyond which those that no rollout is on are forgotten.
        """
        maps = {id(start.scene): start for start in starts}
        new = [scene for scene in maps if scene not in self._held]
        if not new:
            return
        earlier = [scene for scene in self._held if scene not in maps]
        kept = earlier[max(0, len(earlier) + len(maps) - max(most, len(maps))) :]
        self._held = {scene: self._held[scene] for scene in kept} | maps
        self._encode([maps[scene] for scene in new])
        self._encoded = {scene: self._encoded[scene] for scene in self._held}
        known = self._tiles.items()
        self._tiles = {scene: tiles for scene, tiles in known if scene in self._held}
        roads = _collate(list(self._held.values()))
        self.features = self._simulator.stepper.lay_out_maps(
            to_device(roads, self._simulator.device),
            torch.cat(list(self._encoded.values())),
        )
        self._segments = None
        self._mask, self._stalls = self._make_mask(), self._make_stalls(roads)

    def number(self, starts: Sequence[RolloutStart]) -> Scenes:
        """Return the map of each rollout."""
        at = {scene: number for number, scene in enumerate(self._held)}
        return np.array([at[id(start.scene)] for start in starts], dtype=np.int64)

    def insertion_mask(self, scene: Scenes) -> InsertionMask | None:
        """Return the insertion mask, or None if it is off."""
        return None if self._mask is None else replace(self._mask, scene=scene)

    def motion_check(self, scene: Scenes) -> MotionCheck:
        """Return the check of motion tokens."""
        tiles: list[RoadEdgeTiles] = []
        if self._simulator.rules.reject_off_road:
            for scene_id, start in self._held.items():
                if scene_id not in self._tiles:
                    self._tiles[scene_id] = RoadEdgeTiles(start.scene)
            tiles = [self._tiles[scene_id] for scene_id in self._held]
        return MotionCheck(self._simulator.vocabulary, tiles, scene)

    def stall_rule(self, scene: Scenes) -> StallRule | None:
        """Return a stall rule without history, or None if it is off."""
        return None if self._stalls is None else self._stalls.without_history(scene)

    def density(self, control: DensityControl, scene: Scenes) -> DensityControl:
        """Bring a density control to these maps."""
        if self._segments is None:
            self._segments = [segments_of(start.scene) for start in self._held.values()]
        return replace(control, segments=self._segments, scene=scene)

    def _make_mask(self) -> InsertionMask | None:
        simulator = self._simulator
        if not simulator.rules.insertion_mask:
            return None
        return make_insertion_mask(
            [start.history for start in self._held.values()],
            (simulator.vocabulary, simulator.roads),
            np.zeros(0, dtype=np.int64),
            simulator.rules.insertion_lane_distance_m,
        )

    def _make_stalls(self, roads: MapTokens) -> StallRule | None:
        tokens = math.ceil(self._simulator.rules.max_stall_s / CLOCK.token_s)
        if not tokens:
            return None
        # It runs on the host, so it keeps the maps that were given.
        scenes = [start.scene for start in self._held.values()]
        nobody = np.zeros(0, dtype=np.int64)
        return StallRule(scenes, nobody, StopLines.of(roads), tokens)

    def _encode(self, starts: Sequence[RolloutStart]) -> None:
        """Encode the maps of scenes together; each is kept by itself."""
        roads, simulator = _collate(starts), self._simulator
        encoded = simulator.stepper.encode_maps(to_device(roads, simulator.device))
        parts = torch.split(encoded, roads.real.sum(dim=1).tolist())
        for start, part in zip(starts, parts, strict=True):
            self._encoded[id(start.scene)] = part


def _collate(maps: Sequence[RolloutStart]) -> MapTokens:
    """Collate the maps of rollouts on different ones."""
    histories = [start.history for start in maps]
    return collate_maps(
        histories,
        max(history.num_map_tokens for history in histories),
        [start.lights for start in maps],
    )
