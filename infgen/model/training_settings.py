"""Settings of the stage ``train``."""

import math
from dataclasses import dataclass

from infgen.coerce import ConfigError, check_numbers, free


@dataclass(frozen=True, slots=True)
class TrainSettings:
    """How the network learns (SPEC 5).

    Attributes:
        split: Split to learn from (start of the file name).
        validation_split: Split of the validation loss.
        steps: Optimiser steps.
        batch_scenes: Scenes per step.
        learning_rate: Peak of the schedule.
        warmup_steps: Steps of linear warm-up before the cosine.
        weight_decay: AdamW's.
        max_gradient_norm: Largest gradient norm.
        ema_decay: Of the averaged weights; 0 for none.
        label_smoothing: Of motion, cell and map tokens.
        first_motion_weight: Weight of a newcomer's first move in the motion loss.
        motion_weight, position_weight, heading_weight, keep_weight, add_weight,
        size_weight,
        agent_type_weight, offset_weight, map_weight: Weights of the loss terms. The paper's
            are the profile ``paper-loss``.
        position_regression_weight, heading_regression_weight: The same, where places and
            headings are regressed.
        validity_pattern_weight: The same, of validity patterns.
        max_agents: Agents per scene that a batch holds (nearest to the ego first).
        max_map_tokens: Road tokens per scene that a batch holds (nearest to the ego first).
        max_token_steps: Half seconds per scene that a batch holds; a part of longer logs.
        motion_noise_neighbours: Moves nearest to the true one that each agent's next one is
            drawn from, while it is learned to come back (SMART: 5; SPEC 2.3); 0 for moves
            as logged.
        motion_noise_share: Of moves, how many are drawn; the others lead back as well as
            can be.
        lateral_drift_share: Share of the agents on the move that drift beside their ways
            for seconds, up to a metre or two, while they are learned to come back.
        map_noise_neighbours: Shapes nearest to the true one that a road token is drawn from
            (SPEC 1.3); 0 for the true ones.
        accumulate: Parts that a batch is cut into, one after the other, to save memory; the
            gradient is that of the whole batch. Each process has so many.
        bucket_batches: So many batches are drawn at a time and scenes of about one size put
            together; 1 for scenes as they are drawn.
        precision: ``float32``; ``bf16`` for matrix products of half the bits (geometry and
            losses stay as they are); or ``auto``, bf16 on a GPU that has it.
        compile: Whether to compile the network: ``true``, ``false``, or ``auto``, on a GPU.
        start: Folder or key of a stage ``train`` whose weights are gone on from, or
            ``builtin`` for those of the package; empty for fresh ones.
        closed_loop_top_k: Most likely moves from which the one nearest to the log is taken
            to play scenes before they are learned from (CatK, SPEC 7.1); 0 for scenes as
            logged.
        loader_workers: Processes that prepare batches; 0 for a thread.
        tensorboard: Whether to write event files for TensorBoard.
        peer_timeout_s: Longest wait for another process of the same training run.
        checkpoint_every_steps: Steps between checkpoints; 0 for none by steps.
        checkpoint_minutes: Time between checkpoints; 0 for none by time.
        validate_every_steps: Steps between validation losses; 0 for only at the end.
        validation_scenes: Scenes of the validation loss.
        seed: Of initial weights, order of scenes and dropout.

    Settings that ``free`` marks change nothing of what is learned.
    """

    split: str = "training"
    validation_split: str = "validation"
    steps: int = 100_000
    batch_scenes: int = 16
    learning_rate: float = 5e-4
    warmup_steps: int = 500
    weight_decay: float = 0.01
    max_gradient_norm: float = 0.5
    ema_decay: float = 0.999
    label_smoothing: float = 0.1
    first_motion_weight: float = 3.0
    motion_weight: float = 1.0
    position_weight: float = 1.0
    heading_weight: float = 1.0
    keep_weight: float = 1.0
    add_weight: float = 1.0
    size_weight: float = 1.0
    agent_type_weight: float = 1.0
    offset_weight: float = 1.0
    map_weight: float = 1.0
    position_regression_weight: float = 10.0
    heading_regression_weight: float = 10.0
    validity_pattern_weight: float = 1.0
    max_agents: int = 128
    max_map_tokens: int = 4096
    max_token_steps: int = 18
    motion_noise_neighbours: int = 0
    motion_noise_share: float = 1.0
    lateral_drift_share: float = 0.0
    map_noise_neighbours: int = 0
    accumulate: int = 1
    bucket_batches: int = 64
    precision: str = "auto"
    compile: str = "auto"
    start: str = free("")  # What it names is among the stage's sources.
    closed_loop_top_k: int = 0
    loader_workers: int = free(0)
    tensorboard: bool = free(False)
    peer_timeout_s: float = free(600.0)
    checkpoint_every_steps: int = free(500)
    checkpoint_minutes: float = free(10.0)
    validate_every_steps: int = 0
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
        shares = (
            "ema_decay",
            "label_smoothing",
            "motion_noise_share",
            "lateral_drift_share",
        )
        bounds = {
            **dict.fromkeys(one_or_more, (1, math.inf)),
            **dict.fromkeys(shares, (0, 1)),
            "max_gradient_norm": (1e-6, math.inf),
            "max_token_steps": (2, math.inf),  # After one alone nothing comes.
            "peer_timeout_s": (1, math.inf),
            "seed": (0, 2**63 - 1),
        }
        check_numbers(self, "train", bounds)
        for noise in ("motion_noise_neighbours", "lateral_drift_share"):
            if self.closed_loop_top_k and getattr(self, noise):
                raise ConfigError(
                    f"train.closed_loop_top_k and train.{noise} both lead agents off their "
                    "ways; set one of them to 0"
                )
        if self.accumulate > self.batch_scenes:
            raise ConfigError(
                f"train.accumulate is {self.accumulate}, more than the "
                f"{self.batch_scenes} scenes of a batch"
            )
