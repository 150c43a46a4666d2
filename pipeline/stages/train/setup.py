"""What is trained on what, and the network it begins with."""

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from infgen.config import ModelSettings, TokenSettings, TrainSettings
from infgen.model.batching.batch import Limits
from infgen.model.network import Network
from infgen.tokens.scene_tokens import SceneTokens
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary
from pipeline.stages.train.loader import Recipe, TokenScenes
from pipeline.stages.train.process_group import ProcessGroup, own_device
from pipeline.stages.train.sampler import Mixture, ScenePermutation
from pipeline.stages.train.source_shares import mix, read_shares
from pipeline.storage.checkpoint import TrainingState
from pipeline.storage.weights import copy_weights


class TrainingError(ValueError):
    """TrainingState that cannot go on."""


@dataclass(frozen=True, slots=True)
class TrainingSetup:
    """What is trained on what.

    Attributes:
        model: Sizes.
        train: How.
        grid: How the scenes were tokenized.
        scenes: To learn from.
        validation_split: For the validation loss.
        folder: Where checkpoints and the log go.
        start: Folder of the weights to begin with; None for fresh ones.
        sources: Source of each shard of the scenes to learn from.
    """

    model: ModelSettings
    train: TrainSettings
    grid: TokenSettings
    scenes: TokenScenes
    validation_split: Sequence[SceneTokens]
    folder: Path
    start: Path | None = None
    sources: tuple[str, ...] = ()

    @property
    def limits(self) -> Limits:
        """How much of a scene a batch holds."""
        return Limits.of(self.model, self.train, self.grid)

    def recipe(self, group: ProcessGroup) -> Recipe:
        """Say what this process makes of the batch of each step.

        Raises:
            TrainingError: if there is nothing to learn from, or not enough for every
                process.
        """
        how = self.train
        if how.steps and not len(self.scenes):
            raise TrainingError(f"no scenes of split {how.split!r} to train on")
        parts = how.gradient_accumulation * group.size
        if parts > how.batch_scenes:
            raise TrainingError(
                f"train.batch_scenes is {how.batch_scenes}, too few for {group.size} "
                f"processes with {how.gradient_accumulation} parts each; expected {parts} "
                "or more"
            )
        sizes = self.scenes.sizes(self.limits)
        order = ScenePermutation(
            size=sizes,
            batch=how.batch_scenes,
            pool=how.bucket_batches,
            seed=how.seed,
            mixture=self._mixture(),
            most=how.max_scenes,
            skip=how.skip_steps,
        )
        first = group.rank * how.gradient_accumulation
        own = range(first, first + how.gradient_accumulation)
        packed = group.device.type != "cpu"
        return Recipe(self.scenes, self.limits, order, parts, own, packed=packed)

    @property
    def num_scenes(self) -> int:
        """Number of scenes that are learned from."""
        return min(len(self.scenes), self.train.max_scenes or len(self.scenes))

    def _mixture(self) -> Mixture | None:
        shares = read_shares(self.train.source_share)
        return mix(shares, self.sources, self.scenes.shard_sizes) if shares else None


def begin(
    setup: TrainingSetup, motion: MotionVocabulary, roads: MapVocabulary
) -> TrainingState:
    """Make a network with its first weights, and its optimiser.

    Raises:
        StoreError: if the weights to begin with do not fit.
        TrainingError: if no parameter is to be trained.
    """
    torch.manual_seed(setup.train.seed)
    network = Network(setup.model, motion, roads, setup.grid)
    if setup.start is not None:
        copy_weights(network, setup.start)
    network = network.to(own_device())
    _choose_trained(network, setup.train.trained_parts)
    parameters = [p for p in network.parameters() if p.requires_grad]
    decay = setup.train.weight_decay
    optimiser = torch.optim.AdamW(
        [
            {"params": [p for p in parameters if p.dim() > 1], "weight_decay": decay},
            {"params": [p for p in parameters if p.dim() <= 1], "weight_decay": 0.0},
        ],
        lr=setup.train.learning_rate,
        fused=True,
    )
    average = {name: p.detach().clone() for name, p in network.named_parameters()}
    return TrainingState(
        network,
        average if setup.train.ema_decay else {},
        optimiser,
        _frozen(network) if setup.train.policy_gradient_rollouts else None,
    )


def _choose_trained(network: Network, parts: str) -> None:
    """Keep all parameters as they are but those of the named parts, if parts are named."""
    names = tuple(part.strip() for part in parts.split(",") if part.strip())
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(not names or name.startswith(names))
    if not any(parameter.requires_grad for parameter in network.parameters()):
        known = sorted({name.split(".")[0] for name, _ in network.named_parameters()})
        raise TrainingError(
            f"no parameter's name begins with train.trained_parts={parts!r}; names begin "
            f"with {', '.join(known)}"
        )


def _frozen(network: Network) -> Network:
    """Copy a network that is not to change any more."""
    return copy.deepcopy(network).eval().requires_grad_(requires_grad=False)


@contextmanager
def repeatable() -> Iterator[None]:
    """Make equal runs give equal bits, as long as they use as many threads.

    The number of threads is torch's own choice: all cores, or what OMP_NUM_THREADS says.
    """
    strict = torch.are_deterministic_algorithms_enabled()
    filled = torch.utils.deterministic.fill_uninitialized_memory  # type: ignore[attr-defined]
    torch.use_deterministic_algorithms(True, warn_only=own_device().type != "cpu")
    # Nothing here reads memory before it is written; filling it costs a tenth of a step.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(strict)
        torch.utils.deterministic.fill_uninitialized_memory = filled  # type: ignore[attr-defined]
