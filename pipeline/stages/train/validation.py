"""What the averaged weights are worth on scenes that nothing was learned from."""

import math
from typing import Any

import torch
from torch import Tensor

from infgen.model.batching.batch import to_device
from infgen.model.training.diagnostics import (
    BIN_EDGES,
    decisions,
    motion_surprise,
    reliability,
)
from infgen.model.training.losses import Terms, figures, losses, total
from pipeline.stages.train.loader import validation_batches
from pipeline.stages.train.precision import Pass
from pipeline.stages.train.setup import TrainingSetup
from pipeline.storage.checkpoint import TrainingState

Found = dict[str, Any]
"""Figures by name; ``<term>_bins`` are dictionaries of lists, one number a bin."""


@torch.no_grad()
def validate(setup: TrainingSetup, training: TrainingState, forward: Pass) -> Found:
    """Figures of the averaged weights over the held-out scenes; empty without any."""
    settings = setup.train
    training.network.eval()
    device = next(training.network.parameters()).device
    terms: Terms = {}
    bins: dict[str, Tensor] = {}
    surprise = torch.zeros(2, device=device)
    for batch in validation_batches(
        setup.validation_split,
        setup.limits,
        max(1, settings.batch_scenes // settings.gradient_accumulation),
        settings.seed,
        settings.validation_scenes,
    ):
        here = to_device(batch, device)
        outputs = forward.averaged(here, training.average)
        for name, term in losses(outputs, here, settings.of_the_log).items():
            terms[name] = terms[name] + term if name in terms else term
        for name, (probability, happened) in decisions(outputs, here).items():
            found = reliability(probability, happened)
            bins[name] = bins[name] + found if name in bins else found
        surprise += motion_surprise(outputs, here)
    if not terms:
        return {}
    nats, count = surprise.tolist()
    return {
        "total": float(total(terms, settings.of_the_log)),
        **figures(terms),
        "motion_perplexity": math.exp(min(nats / max(count, 1.0), 700.0)),
        **{f"{name}_bins": _bins(found) for name, found in bins.items()},
    }


def _bins(found: Tensor) -> dict[str, list[float]]:
    count, predicted, happened = found.tolist()
    return {
        "edges": list(BIN_EDGES),
        "count": count,
        "predicted": predicted,
        "happened": happened,
    }
