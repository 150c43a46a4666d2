"""Every setting, as frozen dataclasses, one per stage.

``stages.yaml`` and ``-s key=value`` become these through ``build``, once, before anything
runs. A value that follows from others is a property, not a setting.
"""

import math
from dataclasses import dataclass, fields

from infgen.coerce import ConfigError as ConfigError
from infgen.coerce import build as build
from infgen.coerce import check_numbers, free
from infgen.coerce import decisive as decisive
from infgen.coerce import settle as settle
from infgen.metrics.settings import ReferenceSettings as ReferenceSettings
from infgen.metrics.settings import ReportSettings as ReportSettings
from infgen.metrics.settings import ScoreSettings as ScoreSettings
from infgen.rollout.calibration_settings import CalibrateSettings as CalibrateSettings
from infgen.rollout.settings import RolloutSettings as RolloutSettings
from infgen.tokens.clustering.settings import VocabSettings as VocabSettings


@dataclass(frozen=True, slots=True)
class IngestSettings:
    """How records become scenes.

    Attributes:
        max_scenes_per_shard: Scenes in one Zarr group.
        limit: Scenes to take from each file; 0 for all.
    """

    max_scenes_per_shard: int = 500
    limit: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ConfigError: naming the setting, its value and what is expected.
        """
        check_numbers(self, "ingest", {"max_scenes_per_shard": (1, math.inf)})


@dataclass(frozen=True, slots=True)
class TokenSettings:
    """How scenes become tokens (SPEC 1.2, 1.6, 3).

    Attributes:
        max_gap_s: Longer gaps in a track are kept as gaps; shorter ones are filled.
        max_distance_m: An agent farther from the ego is not observed.
        enter_distance_m: Who comes after the history is not observed before it has been
            within it of the ego, and enters there; 0 for wherever it is first seen, as in
            the paper. A simulation can put newcomers into the grid only: it never has
            those who come from beyond, and whoever learns with them misses them.
        near_distance_m: Agents never within it get no motion loss.
        grid_radius_m: Radius of the ego's grid of cells.
        grid_step_m: Spacing of its cells.
        heading_step_deg: Width of a heading bin.
        entry_order: Order of newcomers in a half second: ``distance`` or ``bearing``.
    """

    max_gap_s: float = 1.0
    max_distance_m: float = 150.0
    enter_distance_m: float = 0.0
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
        bounds = {
            **dict.fromkeys(("max_distance_m", "near_distance_m"), (1, math.inf)),
            "grid_radius_m": (1, math.inf),
            "grid_step_m": (0.1, math.inf),
            "heading_step_deg": (0.1, 360),
        }
        check_numbers(self, "tokenize", bounds)
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
        map_agent_ahead_m: They are those nearest to (and within the radius of) a point so
            far ahead of the agent: what lies behind, it has passed.
        map_agent_across: Whether an agent is also told how far to the side of each of them
            it is: of a lane's tokens, how far off the lane's centre it drives.
        agent_agent_neighbours: Nearest agents that an agent sees.
        query_map_neighbours: Nearest map tokens that a query for a cell sees.
        heading_map_neighbours: Nearest map tokens that a query for a heading sees.
        heading_agent_neighbours: Nearest agents that a query for a heading sees.
        max_entries: Newcomers per half second that are supervised (L').
        life_cycle: Whether agents enter and leave. Without it nothing is left but motion:
            SMART (SPEC 7.1). The next three switches are the ablations of SPEC 7.2.
        leave_token: Whether the network says who leaves.
        cell_token: Whether newcomers are placed by cell and offset, not by regression.
        heading_token: Whether newcomers' headings are bins, not regressed.
        pattern_tokens: Whether the network says at which steps of the next half second a
            log would show the agent: detections flicker.
        ground_width: Features of every cell by which newcomers' cells and headings are told
            from the street that is there; 0 to tell them from the query alone, as the
            paper does.
        move_width: Features of every move by which the next one is told from where it
            leads; 0 for a logit per move, each learned alone, as in the paper.
        tell_ego: Whether the ego's embedding says that it is the ego: whoever records is
            under way, where one that looks the same may be parked.
        step_lights: Whether agents see traffic lights as they are in each half second, not
            as they were at the end of the history; in rollouts, ``rollout.lights`` says
            what they show. In half of the scenes of a training nobody looks at them after
            the history, so that rollouts may go on without.
        light_ahead_m: So far ahead every agent is told by itself what the traffic light of
            its lane shows, and for how long it has; 0 for only among all other road tokens.
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
    map_agent_ahead_m: float = 0.0
    map_agent_across: bool = False
    agent_agent_neighbours: int = 64
    query_map_neighbours: int = 256
    heading_map_neighbours: int = 32
    heading_agent_neighbours: int = 16
    max_entries: int = 10
    life_cycle: bool = True
    leave_token: bool = True
    cell_token: bool = True
    heading_token: bool = True
    pattern_tokens: bool = False
    ground_width: int = 0
    move_width: int = 0
    tell_ego: bool = False
    step_lights: bool = False
    light_ahead_m: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what no network can be made of.

        Raises:
            ConfigError: naming the setting, its value and what is expected.
        """
        one_or_more = ("width", "heads", "motion_blocks", "fourier_bands", "window_tokens")
        bounds = {
            **dict.fromkeys(one_or_more, (1, math.inf)),
            **{f.name: (1, math.inf) for f in fields(self) if "_neighbours" in f.name},
            "dropout": (0, 1),
        }
        check_numbers(self, "model", bounds)
        if self.width % self.heads:
            raise ConfigError(
                f"model.width is {self.width}; expected a multiple of model.heads "
                f"({self.heads})"
            )
        if self.light_ahead_m and not self.step_lights:
            raise ConfigError(
                f"model.light_ahead_m is {self.light_ahead_m:g}, which needs "
                "model.step_lights=true; set that as well, or model.light_ahead_m=0"
            )


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
        kind_weight, offset_weight, map_weight: Weights of the loss terms. The paper's are
            the profile ``paper-loss``.
        place_weight, turn_weight: The same, where places and headings are regressed.
        pattern_weight: The same, of validity patterns.
        max_agents: Agents per scene that a batch holds (nearest to the ego first).
        max_roads: Road tokens per scene that a batch holds (nearest to the ego first).
        max_tokens: Half seconds per scene that a batch holds; a part of longer logs.
        noise_moves: Moves nearest to the true one that each agent's next one is drawn from,
            while it is learned to come back (SMART: 5; SPEC 2.3); 0 for moves as logged.
        noise_share: Of moves, how many are drawn; the others lead back as well as can be.
        noise_drift: Share of the agents on the move that drift beside their ways for
            seconds, up to a metre or two, while they are learned to come back.
        noise_roads: Shapes nearest to the true one that a road token is drawn from (SPEC
            1.3); 0 for the true ones.
        accumulate: Parts that a batch is cut into, one after the other, to save memory; the
            gradient is that of the whole batch. Each process has so many.
        bucket_batches: So many batches are drawn at a time and scenes of about one size put
            together; 1 for scenes as they are drawn.
        precision: ``float32``; ``bf16`` for matrix products of half the bits (geometry and
            losses stay as they are); or ``auto``, bf16 on a GPU that has it.
        compile: Whether to compile the network: ``true``, ``false``, or ``auto``, on a GPU.
        start: Folder or key of a stage ``train`` whose weights are gone on from, or
            ``builtin`` for those of the package; empty for fresh ones.
        closed_loop_top: Most likely moves from which the one nearest to the log is taken to
            play scenes before they are learned from (CatK, SPEC 7.1); 0 for scenes as
            logged.
        loader_workers: Processes that prepare batches; 0 for a thread.
        tensorboard: Whether to write event files for TensorBoard.
        peer_timeout_s: Longest wait for another process of the same training run.
        checkpoint_every: Steps between checkpoints; 0 for none by steps.
        checkpoint_minutes: Time between checkpoints; 0 for none by time.
        validate_every: Steps between validation losses; 0 for only at the end.
        validation_scenes: Scenes of the validation loss.
        seed: Of initial weights, order of scenes and dropout.

    Settings that ``free`` marks change nothing of what is learned.
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
    stay_weight: float = 1.0
    add_weight: float = 1.0
    size_weight: float = 1.0
    kind_weight: float = 1.0
    offset_weight: float = 1.0
    map_weight: float = 1.0
    place_weight: float = 10.0
    turn_weight: float = 10.0
    pattern_weight: float = 1.0
    max_agents: int = 128
    max_roads: int = 4096
    max_tokens: int = 18
    noise_moves: int = 0
    noise_share: float = 1.0
    noise_drift: float = 0.0
    noise_roads: int = 0
    accumulate: int = 1
    bucket_batches: int = 64
    precision: str = "auto"
    compile: str = "auto"
    start: str = free("")  # What it names is among the stage's sources.
    closed_loop_top: int = 0
    loader_workers: int = free(0)
    tensorboard: bool = free(False)
    peer_timeout_s: float = free(600.0)
    checkpoint_every: int = free(500)
    checkpoint_minutes: float = free(10.0)
    validate_every: int = 0
    validation_scenes: int = 64
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what nothing can be trained with.

        Raises:
            ConfigError: naming the setting.
        """
        for name, words in (
            ("precision", ("auto", "float32", "bf16")),
            ("compile", ("auto", "true", "false")),
        ):
            value = getattr(self, name)
            if value not in words:
                expected = " or ".join(words)
                raise ConfigError(f"train.{name} is {value!r}; expected {expected}")
        one_or_more = ("batch_scenes", "max_agents", "accumulate", "bucket_batches")
        shares = ("ema_decay", "label_smoothing", "noise_share", "noise_drift")
        bounds = {
            **dict.fromkeys(one_or_more, (1, math.inf)),
            **dict.fromkeys(shares, (0, 1)),
            "clip_norm": (1e-6, math.inf),
            "max_tokens": (2, math.inf),  # After one alone nothing comes.
            "peer_timeout_s": (1, math.inf),
            "seed": (0, 2**63 - 1),
        }
        check_numbers(self, "train", bounds)
        for noise in ("noise_moves", "noise_drift"):
            if self.closed_loop_top and getattr(self, noise):
                raise ConfigError(
                    f"train.closed_loop_top and train.{noise} both lead agents off their "
                    "ways; set one of them to 0"
                )
        if self.accumulate > self.batch_scenes:
            raise ConfigError(
                f"train.accumulate is {self.accumulate}, more than the "
                f"{self.batch_scenes} scenes of a batch"
            )
