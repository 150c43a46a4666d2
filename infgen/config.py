"""Every setting, as frozen dataclasses, one per stage.

``stages.yaml`` and ``-s key=value`` become these through ``build``, once, before anything
runs. A value that follows from others is a property, not a setting.
"""

import types
from collections.abc import Mapping
from dataclasses import dataclass, fields
from difflib import get_close_matches
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


class ConfigError(ValueError):
    """A setting that does not exist or cannot have that value."""


@dataclass(frozen=True, slots=True)
class IngestSettings:
    """How records become scenes.

    Attributes:
        max_scenes_per_shard: Scenes in one Zarr group.
        limit: Scenes to take from each file; 0 for all.
    """

    max_scenes_per_shard: int = 500
    limit: int = 0


@dataclass(frozen=True, slots=True)
class VocabSettings:
    """How the two codebooks are clustered (SPEC 2.1, 1.3).

    Attributes:
        split: Split whose scenes the codebooks are made from (start of the file name).
        held_out: Split that the reports measure coverage on.
        num_moves: Moves per kind of agent.
        num_roads: Five-metre pieces of map lines.
        tolerance_m: Radius of a disk: mean distance of corners between two moves.
        road_tolerance_m: Radius of a disk of map pieces; 0 to search the one that fills
            ``num_roads``.
        segments_per_shard: Most segments of a kind taken from one shard.
        segments_per_kind: Most segments of a kind clustered.
        mirror: Add left/right mirrored segments where a kind would not fill its codebook.
        vehicle_max_speed_mps: No move is faster.
        cyclist_max_speed_mps: No move is faster.
        pedestrian_max_speed_mps: No move is faster.
        max_accel_mps2: No segment changes its speed faster.
        max_yaw_rate_rad_s: No moving segment of a vehicle or cyclist turns faster.
        seed: Of the order in which disks are laid.
    """

    split: str = "training"
    held_out: str = "validation"
    num_moves: int = 2048
    num_roads: int = 1024
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

    def __post_init__(self) -> None:
        """Refuse what no codebook can be made with.

        Raises:
            ConfigError: naming the setting.
        """
        for name, least, most in (
            ("num_moves", 2, 2**15 - 1),
            ("num_roads", 1, 2**15 - 1),
            ("tolerance_m", 0.001, 2.0),
            ("road_tolerance_m", 0.0, 2.0),
            ("segments_per_shard", 1, float("inf")),
            ("segments_per_kind", 1, float("inf")),
            ("vehicle_max_speed_mps", 1.0, 100.0),
            ("cyclist_max_speed_mps", 1.0, 100.0),
            ("pedestrian_max_speed_mps", 1.0, 100.0),
            ("max_accel_mps2", 1.0, 1000.0),
            ("max_yaw_rate_rad_s", 0.1, 30.0),
        ):
            value = getattr(self, name)
            if not least <= value <= most:
                raise ConfigError(
                    f"build-vocab.{name} is {value}; expected {least:g} to {most:g}"
                )


@dataclass(frozen=True, slots=True)
class TokenSettings:
    """How scenes become tokens (SPEC 1.2, 1.6, 3).

    Attributes:
        max_gap_s: Longer gaps in a track are kept as gaps; shorter ones are filled.
        max_distance_m: An agent farther from the ego is not observed.
        near_distance_m: Agents never within it get no motion loss.
        grid_radius_m: Radius of the ego's grid of cells.
        grid_step_m: Spacing of its cells.
        heading_step_deg: Width of a heading bin.
        entry_order: Order of newcomers in a half second: ``distance`` or ``bearing``.
    """

    max_gap_s: float = 1.0
    max_distance_m: float = 150.0
    near_distance_m: float = 100.0
    grid_radius_m: float = 75.0
    grid_step_m: float = 3.0
    heading_step_deg: float = 3.0
    entry_order: str = "distance"

    def __post_init__(self) -> None:
        """Refuse contradictions.

        Raises:
            ConfigError: naming the setting.
        """
        if self.entry_order not in ("distance", "bearing"):
            raise ConfigError(
                f"tokenize.entry_order is {self.entry_order!r}; "
                "expected 'distance' or 'bearing'"
            )
        if 360 % self.heading_step_deg:
            raise ConfigError(
                f"tokenize.heading_step_deg {self.heading_step_deg} does not divide 360"
            )


@dataclass(frozen=True, slots=True)
class ModelSettings:
    """The network's sizes and reach (SPEC 4; the paper's table 4).

    Attributes:
        width: Width of every feature (D).
        heads: Attention heads.
        map_blocks: Blocks of the map encoder.
        motion_blocks: Blocks of the motion stack.
        scene_blocks: Blocks of the scene stack.
        fourier_bands: Learned frequencies per scalar.
        dropout: Of attention weights and feed-forward layers.
        window_tokens: Past tokens that temporal attention sees.
        map_map_radius_m: Reach of map tokens among themselves.
        map_agent_radius_m: Reach of an agent to the map.
        agent_agent_radius_m: Reach of agents among themselves.
        query_radius_m: Reach of the query for a newcomer's cell.
        heading_radius_m: Reach of the query for a newcomer's heading.
        map_map_neighbours: Nearest map tokens that a map token sees.
        map_agent_neighbours: Nearest map tokens that an agent sees.
        agent_agent_neighbours: Nearest agents that an agent sees.
        query_map_neighbours: Nearest map tokens that a query for a cell sees.
        heading_map_neighbours: Nearest map tokens that a query for a heading sees.
        heading_agent_neighbours: Nearest agents that a query for a heading sees.
        max_entries: Newcomers per half second that are supervised (L').
    """

    width: int = 128
    heads: int = 8
    map_blocks: int = 3
    motion_blocks: int = 6
    scene_blocks: int = 3
    fourier_bands: int = 64
    dropout: float = 0.1
    window_tokens: int = 12
    map_map_radius_m: float = 10.0
    map_agent_radius_m: float = 30.0
    agent_agent_radius_m: float = 60.0
    query_radius_m: float = 75.0
    heading_radius_m: float = 10.0
    map_map_neighbours: int = 32
    map_agent_neighbours: int = 64
    agent_agent_neighbours: int = 64
    query_map_neighbours: int = 256
    heading_map_neighbours: int = 32
    heading_agent_neighbours: int = 16
    max_entries: int = 10


@dataclass(frozen=True, slots=True)
class TrainSettings:
    """How the network learns (SPEC 5).

    Attributes:
        split: Split to learn from (start of the file name).
        held_out: Split of the validation loss.
        steps: Optimiser steps.
        batch_scenes: Scenes per step.
        learning_rate: Peak of the schedule.
        warmup_steps: Steps of linear warm-up before the cosine.
        weight_decay: AdamW's.
        clip_norm: Largest gradient norm.
        ema_decay: Of the averaged weights; 0 for none.
        label_smoothing: Of motion, cell and map tokens.
        first_move_weight: Weight of a newcomer's first move in the motion loss.
        motion_weight, cell_weight, heading_weight, stay_weight, add_weight, size_weight,
        kind_weight, offset_weight, map_weight: Weights of the loss terms.
        max_agents: Agents per scene that a batch holds (nearest to the ego first).
        max_roads: Road tokens per scene that a batch holds (nearest to the ego first).
        max_tokens: Half seconds per scene that a batch holds; a part of longer logs.
        checkpoint_every: Steps between checkpoints.
        validate_every: Steps between validation losses; 0 for only at the end.
        validation_scenes: Scenes of the validation loss.
        seed: Of initial weights, order of scenes and dropout.
    """

    split: str = "training"
    held_out: str = "validation"
    steps: int = 100_000
    batch_scenes: int = 16
    learning_rate: float = 5e-4
    warmup_steps: int = 500
    weight_decay: float = 0.01
    clip_norm: float = 0.5
    ema_decay: float = 0.999
    label_smoothing: float = 0.1
    first_move_weight: float = 3.0
    motion_weight: float = 1.0
    cell_weight: float = 1.0
    heading_weight: float = 1.0
    stay_weight: float = 10.0
    add_weight: float = 10.0
    size_weight: float = 0.2
    kind_weight: float = 5.0
    offset_weight: float = 5.0
    map_weight: float = 1.0
    max_agents: int = 128
    max_roads: int = 4096
    max_tokens: int = 18
    checkpoint_every: int = 500
    validate_every: int = 0
    validation_scenes: int = 64
    seed: int = 0


@dataclass(frozen=True, slots=True)
class RolloutSettings:
    """How futures are played (SPEC 6).

    Attributes:
        split: Split whose scenes are played (start of the file name).
        seconds: Length of a rollout after the history.
        count: Rollouts per scene.
        scenes: Scenes to play; 0 for all of the split.
        scenes_per_task: Scenes of one unit of work.
        batch: Rollouts that are played at once.
        everyone: Whether to play every agent of the log that is there at now, however far
            from the ego (the WOSAC protocol), or those within ``tokenize.max_distance_m``.
        insert: Whether agents may enter.
        remove: Whether agents may leave.
        top_moves: Most likely moves that are sampled from.
        top_cells: Most likely cells that are sampled from.
        max_entries: Newcomers per half second.
        max_agents: Agents at any one time.
        seed: Of all random streams.
    """

    split: str = "validation"
    seconds: float = 30.0
    count: int = 32
    scenes: int = 0
    scenes_per_task: int = 8
    batch: int = 32
    everyone: bool = False
    insert: bool = True
    remove: bool = True
    top_moves: int = 5
    top_cells: int = 10
    max_entries: int = 16
    max_agents: int = 128
    seed: int = 0


@dataclass(frozen=True, slots=True)
class ReferenceSettings:
    """How logs are measured, and with them the rollouts that are scored against them.

    Attributes:
        split: Whose logs; that of the rollouts.
        window_s: Length of a window.
        stride_s: From one window to the next.
        count_radius_m: Agents within it of the ego are counted; ACE is given for it and for
            no limit.
    """

    split: str = "validation"
    window_s: float = 8.0
    stride_s: float = 0.5
    count_radius_m: float = 75.0


@dataclass(frozen=True, slots=True)
class ScoreSettings:
    """How rollouts are scored (METRICS.md).

    Attributes:
        enter_radius_m: For models that neither insert nor remove: who crosses this distance
            to the ego enters or leaves, and who is beyond it is not there; 0 for never.
        wosac: Version of the Waymo metric, for the first eight seconds.
        resamples: Bootstrap resamples of the scenes behind the 95 % intervals.
        seed: Of the bootstrap.
    """

    enter_radius_m: float = 0.0
    wosac: str = "wosac-2025"
    resamples: int = 1000
    seed: int = 0


@dataclass(frozen=True, slots=True)
class ReportSettings:
    """What the report shows.

    Attributes:
        title: Heading of the report.
    """

    title: str = "InfGen"


def build(kind: type[T], values: Mapping[str, Any], where: str) -> T:
    """Make settings from plain values. A key that is not a field is an error.

    Args:
        kind: The settings' dataclass.
        values: Field names to values, as YAML or the command line gave them.
        where: What to call the place in messages (``stages.yaml:12: train``).

    Raises:
        ConfigError: naming the key, where it stands, and the nearest real one; or the value
            and the type expected.
    """
    return kind(**{key: settle(kind, key, value, where) for key, value in values.items()})


def settle(kind: type, key: str, value: Any, where: str) -> Any:
    """Check one setting and give its value the type of its field.

    Raises:
        ConfigError: as ``build`` does.
    """
    names = [field.name for field in fields(kind)]
    if key not in names:
        near = get_close_matches(key, names, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"there is {', '.join(names)}"
        raise ConfigError(f"{where}: no setting {key!r}; {hint}")
    return coerce(value, get_type_hints(kind)[key], f"{where}.{key}")


def coerce(value: Any, kind: Any, where: str) -> Any:
    """Give a plain value the type of its field.

    A YAML ``5e-4`` arrives as a string and becomes a float; a float is never cut to an int.

    Raises:
        ConfigError: naming the place, the value and the type expected.
    """
    if get_origin(kind) in (Union, types.UnionType):
        if value is None:
            return None
        kind = next(k for k in get_args(kind) if k is not type(None))
    wrong = ConfigError(f"{where} is {value!r}; expected {getattr(kind, '__name__', kind)}")
    if kind is bool:
        words = {"true": True, "false": False}
        if isinstance(value, bool):
            return value
        if str(value).lower() not in words:
            raise wrong
        return words[str(value).lower()]
    if isinstance(value, bool) or value is None:
        raise wrong
    if kind is str:
        return str(value)
    try:
        number = float(value)
        if kind is int and number != int(number):
            raise wrong
        return kind(number)
    except (TypeError, ValueError, OverflowError) as error:
        raise wrong from error
