"""Weights between those that training began with and those that it ended with.

Fine-tuning gains something and loses something else. On the straight line between the two
there are weights that have most of both (Wortsman et al. 2022, arXiv 2109.01903).
"""

from collections.abc import Callable, Collection, Mapping

import torch
from torch import Tensor

from pipeline.stages.train.setup import TrainingSetup
from pipeline.storage.checkpoint import TrainingState
from pipeline.storage.initial_weights import WEIGHTS
from pipeline.storage.weights import read_tensors, state_dict_of

State = dict[str, Tensor]


def mixer(setup: TrainingSetup, begun: TrainingState) -> Callable[[State], State]:
    """Return what makes the weights to write of the trained ones.

    Args:
        setup: Has the share, and the folder of the initial weights.
        begun: Training before its first step, and before it goes on from a checkpoint.
    """
    share = setup.train.initial_share
    if not share or setup.start is None:
        return lambda trained: trained
    initial = {name: x.clone() for name, x in state_dict_of(begun.network).items()}
    given = read_tensors(setup.start / WEIGHTS).keys()
    return lambda trained: mean_with_initial(initial, trained, given, share)


def mean_with_initial(
    initial: Mapping[str, Tensor],
    trained: Mapping[str, Tensor],
    given: Collection[str],
    share: float,
) -> dict[str, Tensor]:
    """Average weights with those that training began with.

    Parts that are new begin with an output of zero: the output is scaled, and what leads to
    it is kept as trained.

    Args:
        initial: As training began, by name.
        trained: As it ended.
        given: Names of those that were not made anew when training began.
        share: Share of the initial ones.
    """
    found = dict(trained)
    for name, begun in initial.items():
        ended = trained[name]
        # Buffers and parameters that were not trained keep their bits.
        if torch.equal(begun, ended):
            continue
        if name in given or not begun.any():
            found[name] = torch.lerp(ended, begun, share)
    return found
