"""Settings of the stage ``build-vocab``; a part of ``infgen.config``."""

import math
from dataclasses import dataclass

from infgen.coerce import check_bounds, free


@dataclass(frozen=True, slots=True)
class VocabSettings:
    """How the two codebooks are clustered (SPEC 2.1, 1.3).

    Attributes:
        split: Split whose scenes the codebooks are made from (start of the file name).
        validation_split: Split that the reports measure coverage on.
        num_motion_tokens: Moves per kind of agent.
        num_map_tokens: Five-metre pieces of map lines.
        tolerance_m: Radius of a disk: mean distance of corners between two moves.
        road_tolerance_m: Radius of a disk of map pieces; 0 to search the one that fills
            ``num_map_tokens``.
        segments_per_shard: Most segments of a kind taken from one shard.
        segments_per_kind: Most segments of a kind clustered.
        mirror: Add left/right mirrored segments where a kind would not fill its codebook.
        vehicle_max_speed_mps: No move is faster.
        cyclist_max_speed_mps: No move is faster.
        pedestrian_max_speed_mps: No move is faster.
        max_accel_mps2: No segment changes its speed faster.
        max_yaw_rate_rad_s: No moving segment of a vehicle or cyclist turns faster.
        seed: Of the order in which disks are laid.
        start: Weights whose codebooks are taken instead of new ones, to go on from them:
            ``builtin``, a folder or key as for ``train.start``. The reports are made anew.

    Settings that ``free`` marks change nothing of what is clustered.
    """

    split: str = "training"
    validation_split: str = "validation"
    num_motion_tokens: int = 2048
    num_map_tokens: int = 1024
    tolerance_m: float = 0.05
    road_tolerance_m: float = 0.0
    segments_per_shard: int = 16384
    segments_per_kind: int = 204800
    mirror: bool = True
    vehicle_max_speed_mps: float = 45.0
    cyclist_max_speed_mps: float = 15.0
    pedestrian_max_speed_mps: float = 6.0
    max_accel_mps2: float = 12.0
    max_yaw_rate_rad_s: float = 2.0
    seed: int = 0
    start: str = free("")  # What it names is among the stage's sources.

    def __post_init__(self) -> None:
        """Refuse what no codebook can be made with.

        Raises:
            ConfigError: naming the setting.
        """
        bounds = (
            ("num_motion_tokens", 2, 2**15 - 1),
            ("num_map_tokens", 1, 2**15 - 1),
            ("tolerance_m", 0.001, 2.0),
            ("road_tolerance_m", 0.0, 2.0),
            ("segments_per_shard", 1, math.inf),
            ("segments_per_kind", 1, math.inf),
            ("vehicle_max_speed_mps", 1.0, 100.0),
            ("cyclist_max_speed_mps", 1.0, 100.0),
            ("pedestrian_max_speed_mps", 1.0, 100.0),
            ("max_accel_mps2", 1.0, 1000.0),
            ("max_yaw_rate_rad_s", 0.1, 30.0),
        )
        check_bounds(self, "build-vocab", bounds)
