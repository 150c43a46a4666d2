"""Settings of stage ``build-vocab``: how the two vocabularies are clustered."""

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from infgen.settings import NOT_IN_KEY, RULES, AtLeastOne, Bool, Float, Int, Seed

MAX_TOKENS = 2**15 - 1
"""Tokens are stored as int16."""
Speed = Annotated[Float, Field(ge=1, le=100)]


@dataclass(frozen=True, slots=True, config=RULES)
class VocabSettings:
    """How the motion and the map vocabulary are clustered (SPEC 2.1, 1.3)."""

    split: str = "training"
    """Split whose scenes are clustered (start of the file name)."""
    validation_split: str = "validation"
    """Split on which the reports measure coverage."""
    num_motion_tokens: Annotated[Int, Field(ge=2, le=MAX_TOKENS)] = 2048
    """Motion tokens per agent type."""
    num_map_tokens: Annotated[Int, Field(ge=1, le=MAX_TOKENS)] = 1024
    """Map tokens: shapes of up to five metres of a map line."""
    tolerance_m: Annotated[Float, Field(ge=0.001, le=2)] = 0.05
    """Radius of a k-disk of motion: mean distance between the corners of two boxes."""
    map_tolerance_m: Annotated[Float, Field(ge=0, le=2)] = 0.0
    """Radius of a k-disk of map shapes; 0 to search for the one that gives
    `num_map_tokens`."""
    samples_per_shard: AtLeastOne = 16384
    """Most motion samples of an agent type that are taken from one shard."""
    samples_per_type: AtLeastOne = 204800
    """Most motion samples of an agent type that are clustered."""
    mirror: Bool = True
    """Whether to add samples mirrored left to right where an agent type has too few for
    its vocabulary."""
    vehicle_max_speed_mps: Speed = 45.0
    """No motion token of a vehicle is faster."""
    cyclist_max_speed_mps: Speed = 15.0
    """No motion token of a cyclist is faster."""
    pedestrian_max_speed_mps: Speed = 6.0
    """No motion token of a pedestrian is faster."""
    max_accel_mps2: Annotated[Float, Field(ge=1, le=1000)] = 12.0
    """No motion sample changes its speed faster."""
    max_yaw_rate_rad_s: Annotated[Float, Field(ge=0.1, le=30)] = 2.0
    """No sample of a moving vehicle or cyclist turns faster."""
    seed: Seed = 0
    """Seed of the order in which k-disks are placed."""
    initial_weights: Annotated[str, NOT_IN_KEY] = ""  # Its fingerprint is a source.
    """Weights whose vocabularies are used instead of new ones, to train on from them:
    `builtin`, a folder or a key, as in `train.initial_weights`. Reports are made anew."""
