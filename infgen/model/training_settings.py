"""Settings of stage ``train``: how the network learns."""

import re
from dataclasses import replace
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator
from pydantic.dataclasses import dataclass

from infgen.settings import (
    NOT_IN_KEY,
    RULES,
    AtLeastOne,
    Bool,
    Count,
    Float,
    Int,
    NonNegative,
    Nucleus,
    Seed,
    Share,
    Text,
)

_SHARE = r"[a-z0-9]+:\d+(\.\d+)?"


def _shares(value: str) -> str:
    if value and not re.fullmatch(rf"{_SHARE}(, ?{_SHARE})*", value):
        raise ValueError("expected sources and shares, as tfrecord:2,argoverse2:1")
    return value


LEAST_ROLLOUTS = 3
"""Rollouts of a scene that a policy gradient needs: of two, one has no spread."""

SourceShares = Annotated[str, AfterValidator(_shares)]


@dataclass(frozen=True, slots=True, config=RULES)
class TrainSettings:
    """How the network learns (SPEC 5).

    The weights of the loss terms are those of the paper in the profile `paper-loss`.
    """

    split: str = "training"
    """Split to learn from (start of the file name)."""
    validation_split: str = "validation"
    """Split of the validation loss."""
    source_share: SourceShares = ""
    """Shares of sources among the scenes of training, as `tfrecord:2,argoverse2:1`; empty
    for every scene as often as any other."""
    max_scenes: Count = 0
    """Scenes to learn from, drawn from those of the split by `train.seed`; fewer are among
    more. 0 for all."""
    skip_steps: Count = 0
    """Steps of the order of scenes that are left out: those that the initial weights were
    trained for, so that the scenes after them are read."""
    steps: Count = 100_000
    """Optimizer steps."""
    batch_scenes: AtLeastOne = 16
    """Scenes per optimizer step."""
    learning_rate: NonNegative = 5e-4
    """Peak of the schedule."""
    warmup_steps: Count = 500
    """Steps of linear warm-up before the cosine."""
    weight_decay: NonNegative = 0.01
    """Weight decay of AdamW."""
    max_gradient_norm: Annotated[Float, Field(ge=1e-6)] = 0.5
    """Gradients are clipped to this norm."""
    ema_decay: Share = 0.999
    """Decay of the moving average of the weights; 0 for none."""
    label_smoothing: Share = 0.1
    """Label smoothing of motion, position and map tokens."""
    first_motion_weight: NonNegative = 3.0
    """Weight of an inserted agent's first motion token in the motion loss."""
    motion_weight: NonNegative = 1.0
    """Weight of the motion loss."""
    position_weight: NonNegative = 1.0
    """Weight of the loss of position tokens."""
    heading_weight: NonNegative = 1.0
    """Weight of the loss of heading tokens."""
    keep_weight: NonNegative = 1.0
    """Weight of the loss of keep and remove tokens."""
    add_weight: NonNegative = 1.0
    """Weight of the loss of add and begin-motion tokens."""
    size_weight: NonNegative = 1.0
    """Weight of the loss of inserted agents' box sizes."""
    agent_type_weight: NonNegative = 1.0
    """Weight of the loss of inserted agents' types."""
    offset_weight: NonNegative = 1.0
    """Weight of the loss of offsets within a cell."""
    offset_token_weight: NonNegative = 1.0
    """Weight of the loss of offset tokens (`model.offset_token`)."""
    map_weight: NonNegative = 1.0
    """Weight of the map loss."""
    position_regression_weight: NonNegative = 10.0
    """Weight of the position loss without `model.position_token`."""
    heading_regression_weight: NonNegative = 10.0
    """Weight of the heading loss without `model.heading_token`."""
    validity_pattern_weight: NonNegative = 1.0
    """Weight of the loss of validity patterns."""
    max_agents: AtLeastOne = 128
    """Agents per scene in a batch, those nearest to the ego first."""
    max_map_tokens: Count = 4096
    """Map tokens per scene in a batch, those nearest to the ego first."""
    max_token_steps: Annotated[Int, Field(ge=2)] = 18  # One alone predicts nothing.
    """Token steps per scene in a batch; longer logs are cropped."""
    motion_noise_neighbours: Count = 0
    """The next motion token of an agent is drawn from so many nearest to the true one, and
    the network learns to come back to the log (SMART: 5; SPEC 2.3); 0 for motion tokens as
    logged."""
    motion_noise_share: Share = 1.0
    """Share of motion tokens that are drawn; the others lead back to the log as well as can
    be."""
    lateral_drift_share: Share = 0.0
    """Share of moving agents that drift sideways for seconds, up to a metre or two, from
    which the network learns to come back."""
    along_recovery: Share = 1.0
    """Share of how far an agent is ahead of its log or behind it, by noise or in closed
    loop, that it makes good in one token step; 1 for all (SMART, CatK), which takes changes
    of speed that no log has."""
    lateral_recovery: Share = 1.0
    """The same of how far it is beside its log, of the motion token to learn; less than all
    leads back in a curve."""
    map_noise_neighbours: Count = 0
    """A map token is drawn from so many shapes nearest to the true one (SPEC 1.3); 0 for
    the true ones."""
    gradient_accumulation: AtLeastOne = 1
    """Parts that a batch is cut into to save memory. The gradient is that of the whole
    batch. With several processes, parts of each process's share."""
    bucket_batches: AtLeastOne = 64
    """So many batches are drawn at a time, and scenes of similar size put together; 1 for
    scenes as they are drawn."""
    precision: Literal["auto", "float32", "bf16"] = "auto"
    """`float32`; `bf16` for matrix products of half the bits (geometry and losses stay
    float32); `auto` is bf16 on a GPU that has it."""
    compile: Annotated[Literal["auto", "true", "false"], Text] = "auto"
    """Whether to compile the network; `auto` does not, until that is measured faster."""
    initial_weights: Annotated[str, NOT_IN_KEY] = ""  # Its fingerprint is a source.
    """Weights to start from: a folder, a key of stage `train`, or `builtin` for those of
    the package; empty for random ones."""
    initial_share: Share = 0.0
    """Share of the initial weights in the mean of them and the trained ones, which is what
    is written at the end; validation is of the trained ones. 0 for the trained ones."""
    trained_parts: str = ""
    """Only parameters whose names begin with one of these, separated by commas, change:
    `details.offset_bins`, say, to add a part to trained weights; empty for all."""
    closed_loop_top_k: Count = 0
    """Scenes are simulated before they are learned from, with the one of so many most
    likely motion tokens that is nearest to the log (CatK, SPEC 7.1); 0 for scenes as
    logged."""
    closed_loop_population: Bool = False
    """Scenes are simulated with the insertions and removals of the network before they are
    learned from, and it learns to correct their number. Agents that the log has too move as
    `closed_loop_top_k` says, or as logged."""
    own_insertion_share: Share = 0.0
    """Share of the insertions that are to be made, in closed loop of insertion and removal,
    in which an agent is inserted as the network samples it, as in rollouts; in the others
    an agent of the log is, at its logged pose."""
    latent_rate_scale: NonNegative = 1.0
    """Latent rates (`model.latent_rates`) vary so much beside what has been learned, in the
    loss and in what the network simulates to learn from: where weights are to be simulated
    with `rollout.latent_rate_scale`, the same. What they are is learned at 1 alone."""
    policy_gradient_rollouts: Count = 0
    """Rollouts of each scene that the network simulates and learns from by policy gradient,
    3 or more; 0 for none. The penalties below are its rewards, the initial weights the
    pretrained network that it stays near to."""
    policy_top_p: Nucleus = 0.9
    """Motion tokens of these rollouts are sampled from the nucleus, as with
    `rollout.motion_top_p`; 1 for all."""
    policy_insertion_mask: Bool = False
    """Agents of these rollouts are inserted at free positions only, as by the rule
    `insertion_mask` of rollouts but for its distance to lanes."""
    policy_minibatches: AtLeastOne = 1
    """Parts that the rollouts of a step are cut into, with an update of the weights for
    each."""
    policy_epochs: AtLeastOne = 1
    """Times that the rollouts of a step are learned from: to simulate them costs as much as
    to learn from them once or twice."""
    policy_discount: Share = 0.9
    """Factor on rewards for each token step that they come later."""
    overlap_penalty: NonNegative = 1.0
    """Cost of running into another agent."""
    conflict_penalty: NonNegative = 0.0
    """Cost of motion tokens by which agents come into conflict, after which an agent that
    brakes still runs into another one: of a nat of the divergence from what the pretrained
    network would have sampled of all others."""
    departure_penalty: NonNegative = 0.0
    """The same of motion tokens by which vehicles drive off the road or stay off it."""
    creeping_penalty: NonNegative = 0.0
    """The same of motion tokens by which vehicles creep on, with no other agent ahead, as
    far as there are more of them than in the logs."""
    insertion_overlap_penalty: NonNegative = 0.0
    """The same of places at which an agent is inserted onto another one, or onto what its
    box sweeps in the next token step."""
    off_road_penalty: NonNegative = 0.5
    """Cost of each token step in which a vehicle leaves the road or gets farther off it."""
    log_distance_penalty: NonNegative = 0.1
    """Cost of the square root of a metre from the logged position, less that from the
    other rollouts, for each token step (an energy score)."""
    placement_penalty: NonNegative = 0.5
    """Cost of a metre (of at most one on either side of the road edge) by which an inserted
    vehicle is farther from those that the scene's log inserts than from other inserted
    ones."""
    speed_penalty: NonNegative = 0.05
    """Cost, for each token step, of a metre per second by which the speed of a vehicle is
    farther from the log's than from that of the other rollouts."""
    ego_speed_penalty: NonNegative = 0.05
    """The same of the ego, in place of `speed_penalty`: it is one of many vehicles, most of
    which stand."""
    agent_type_penalty: NonNegative = 1.0
    """Cost of the type of an inserted agent: its share among the other inserted ones less
    that among those that the scene's log inserts."""
    count_penalty: NonNegative = 0.01
    """Cost, for each token step, of an agent by which the number of agents, and of those
    inserted so far, is farther from the log's than from the other rollouts'."""
    divergence_weight: NonNegative = 0.1
    """Weight of the divergence from the pretrained network: cost of a nat per motion
    token."""
    log_weight: NonNegative = 0.0
    """Weight of the loss terms of the log beside the policy gradient; 0 to leave the log
    out."""
    loader_workers: Annotated[Count | None, NOT_IN_KEY] = None
    """Processes that prepare batches, 0 for a thread; by default two on a GPU, whose
    launches keep this process busy, and a thread on a CPU."""
    tensorboard: Annotated[Bool, NOT_IN_KEY] = False
    """Whether to write event files for TensorBoard."""
    peer_timeout_s: Annotated[Float, Field(ge=1), NOT_IN_KEY] = 600.0
    """Longest wait for another process of the same training run."""
    checkpoint_every_steps: Annotated[Count, NOT_IN_KEY] = 500
    """Steps between checkpoints; 0 for none by steps."""
    checkpoint_minutes: Annotated[NonNegative, NOT_IN_KEY] = 10.0
    """Time between checkpoints; 0 for none by time."""
    validate_every_steps: Count = 0
    """Steps between validation losses; 0 for only at the end."""
    validation_scenes: Count = 64
    """Scenes of the validation loss."""
    seed: Seed = 0
    """Seed of the initial weights, the order of scenes, and dropout."""

    @model_validator(mode="after")
    def _check(self) -> "TrainSettings":
        for noise in ("motion_noise_neighbours", "lateral_drift_share"):
            for simulated in ("closed_loop_top_k", "policy_gradient_rollouts"):
                if getattr(self, simulated) and getattr(self, noise):
                    raise ValueError(
                        f"{simulated} and {noise} both lead agents off their logged "
                        "paths; set one of them to 0"
                    )
        if 0 < self.policy_gradient_rollouts < LEAST_ROLLOUTS:
            raise ValueError(
                f"policy_gradient_rollouts is {self.policy_gradient_rollouts}; expected 0, "
                f"or {LEAST_ROLLOUTS} or more, that each can be compared with others"
            )
        parts = self.policy_gradient_rollouts * self.gradient_accumulation
        if self.policy_minibatches > max(1, parts):
            raise ValueError(
                f"policy_minibatches is {self.policy_minibatches}; expected at most "
                f"{max(1, parts)}, policy_gradient_rollouts times gradient_accumulation"
            )
        if self.max_scenes and self.source_share:
            raise ValueError(
                "max_scenes and source_share both say which scenes are read; leave one out"
            )
        if self.gradient_accumulation > self.batch_scenes:
            raise ValueError(
                f"gradient_accumulation is {self.gradient_accumulation}, more than the "
                f"{self.batch_scenes} scenes of a batch"
            )
        return self

    def loss_weight(self, term: str) -> float:
        """Weight of a loss term, by its name, in what is minimised."""
        if term == "policy":
            return 1.0
        weight: float = getattr(self, f"{term}_weight")
        learns_log = term == "divergence" or not self.policy_gradient_rollouts
        return weight if learns_log else weight * self.log_weight

    @property
    def updates(self) -> int:
        """Updates of the weights in a step: more than one only with rollouts."""
        several = self.policy_minibatches * self.policy_epochs
        return several if self.policy_gradient_rollouts else 1

    @property
    def of_the_log(self) -> "TrainSettings":
        """Return them without simulation: the loss of held-out logs."""
        return replace(
            self, policy_gradient_rollouts=0, policy_minibatches=1, latent_rate_scale=1.0
        )
