"""Settings of rollouts as keywords, so that editors complete them and mypy checks them."""

from typing import Literal, TypedDict

from infgen.rollout.settings import RuleName


class RolloutOverrides(TypedDict, total=False):
    """Any of ``RolloutSettings``, which says what each means (`infgen settings` too).

    Only stage ``rollout`` takes recorded drives (``recordings``).
    """

    split: str
    device: Literal["auto", "cpu", "cuda"]
    precision: Literal["auto", "float32", "bf16"]
    cuda_graphs: bool
    mode: Literal["long", "motion-only", "wosac"]
    seconds: float | None
    count: int
    max_scenes: int
    scenes_per_unit: int
    batch_rollouts: int
    all_agents: bool | None
    insert: bool | None
    remove: bool | None
    removal_radius_m: float
    signals: Literal["now", "log"]
    validity_patterns: bool
    motion_top_k: int
    position_top_k: int
    motion_top_p: float
    position_top_p: float
    offset_top_p: float
    heading_top_p: float
    rules: RuleName
    max_motion_samples: int | None
    reject_off_road: bool | None
    max_stall_s: float | None
    density_control: float | None
    insertion_mask: bool | None
    insertion_lane_distance_m: float | None
    max_insertion_attempts: int | None
    motion_temperature: float
    position_temperature: float
    heading_temperature: float
    add_bias: float
    remove_bias: float
    latent_rate_scale: float
    max_insertions: int
    max_agents: int
    seed: int
