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
from infgen.model.neighbours import MapFeatures
from infgen.model.signal_features import StopLines
from infgen.rollout.insertion_mask import InsertionMask, make_insertion_mask
from infgen.rollout.recording import RolloutStart, number_maps
from infgen.rollout.rules.density import DensityControl, Segments, segments_of
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
        self._held: dict[str, RolloutStart] = {}
        self._encoded: dict[str, Tensor] = {}
        self._tiles: dict[str, RoadEdgeTiles] = {}
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
        maps = {start.scene.scenario_id: start for start in starts}
        new = [name for name, start in maps.items() if not self._holds(name, start)]
        if not new:
            return
        earlier = [name for name in self._held if name not in maps]
        kept = earlier[max(0, len(earlier) + len(maps) - max(most, len(maps))) :]
        self._held = {name: self._held[name] for name in kept} | maps
        self._encode([self._held[name] for name in new])
        held = list(self._held)
        self._encoded = {name: self._encoded[name] for name in held}
        self._tiles = {
            name: tiles for name, tiles in self._tiles.items() if name in self._encoded
        }
        roads = _collate(list(self._held.values()))
        self.features = self._simulator.stepper.lay_out_maps(
            to_device(roads, self._simulator.device),
            torch.cat(list(self._encoded.values())),
        )
        self._segments = None
        self._mask, self._stalls = self._make_mask(), self._make_stalls(roads)

    def number(self, starts: Sequence[RolloutStart]) -> Scenes:
        """Return the map of each rollout."""
        at = {name: number for number, name in enumerate(self._held)}
        return np.array([at[start.scene.scenario_id] for start in starts], dtype=np.int64)

    def insertion_mask(self, scene: Scenes) -> InsertionMask | None:
        """Return the insertion mask, or None if it is off."""
        return None if self._mask is None else replace(self._mask, scene=scene)

    def motion_check(self, scene: Scenes) -> MotionCheck:
        """Return the check of motion tokens."""
        tiles: list[RoadEdgeTiles] = []
        if self._simulator.settings.reject_off_road:
            for name, start in self._held.items():
                if name not in self._tiles:
                    self._tiles[name] = RoadEdgeTiles(start.scene)
            tiles = [self._tiles[name] for name in self._held]
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
        if not simulator.settings.insertion_mask:
            return None
        return make_insertion_mask(
            [start.history for start in self._held.values()],
            (simulator.vocabulary, simulator.roads),
            np.zeros(0, dtype=np.int64),
            simulator.settings.insertion_lane_distance_m,
        )

    def _make_stalls(self, roads: MapTokens) -> StallRule | None:
        tokens = math.ceil(self._simulator.settings.max_stall_s / CLOCK.token_s)
        if not tokens:
            return None
        # It runs on the host, so it keeps the maps that were given.
        scenes = [start.scene for start in self._held.values()]
        nobody = np.zeros(0, dtype=np.int64)
        return StallRule(scenes, nobody, StopLines.of(roads), tokens)

    def _holds(self, name: str, start: RolloutStart) -> bool:
        # Another scene may have the same id: one that a user has changed.
        return name in self._held and self._held[name].scene is start.scene

    def _encode(self, starts: Sequence[RolloutStart]) -> None:
        """Encode the maps of scenes together; each is kept by itself."""
        roads, simulator = _collate(starts), self._simulator
        encoded = simulator.stepper.encode_maps(to_device(roads, simulator.device))
        parts = encoded.split(roads.real.sum(dim=1).tolist())
        for start, part in zip(starts, parts, strict=True):
            self._tiles.pop(start.scene.scenario_id, None)
            self._encoded[start.scene.scenario_id] = part


def _collate(starts: Sequence[RolloutStart]) -> MapTokens:
    """Collate the maps of rollouts; each map once."""
    maps, _ = number_maps(starts)
    histories = [start.history for start in maps]
    return collate_maps(
        histories,
        max(history.num_map_tokens for history in histories),
        [start.lights for start in maps],
    )
