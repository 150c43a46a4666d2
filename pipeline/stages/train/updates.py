"""The updates of one step: all that is learned at once, or the rollouts part by part.

To simulate rollouts costs as much as to learn from them. So they may be cut into parts,
with an update of the weights for each, and learned from several times (PPO: Schulman et al.
2017).
"""

from collections.abc import Iterator, Sequence

import numpy as np

from infgen.config import TrainSettings
from pipeline.stages.train.lessons import Lessons


def cut_into_updates(
    lessons: Sequence[Lessons], settings: TrainSettings, seed: int
) -> Iterator[list[Lessons]]:
    """Go through the updates of a step: what each learns from, of every part of the batch.

    Every rollout is learned from once an epoch, in another order each time; the log, if at
    all, in every update.

    Args:
        lessons: Of this process's parts of the batch.
        settings: Number of epochs, and of updates in each.
        seed: Of the orders.
    """
    if settings.updates == 1:
        yield list(lessons)
        return
    rollouts = [
        (part, number)
        for part, each in enumerate(lessons)
        for number in range(len(each.rollouts.lessons if each.rollouts else ()))
    ]
    for epoch in range(settings.policy_epochs):
        order = np.random.default_rng([seed, epoch]).permutation(len(rollouts))
        for cut in np.array_split(order, settings.policy_minibatches):
            own = [rollouts[at] for at in cut.tolist()]
            yield [
                each.only([number for of, number in own if of == part])
                for part, each in enumerate(lessons)
            ]
