"""What to add to log-odds so that decisions are right token step by token step.

The last validation of a training run has its decisions sorted by their probability. A
network that was shown few scenes often is too sure of them; shifting its log-odds until the
held-out rates are right keeps its ranking and corrects the totals (SPEC 3.6).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from infgen.config import RolloutSettings
from pipeline.engine.atomic import StoreError, write_json
from pipeline.stages.train.train_log import read_log

LOG = "train.jsonl"
FOUND = "biases.json"
FEWEST = 100
"""Fewer decisions, or fewer of either outcome than a tenth of it, decide nothing."""
LARGEST = 3.0
"""No bias is larger."""
_STEPS = 60


@dataclass(frozen=True, slots=True)
class Biases:
    """To be added to log-odds.

    Attributes:
        add: That one more agent enters.
        leave: That an agent leaves.
    """

    add: float = 0.0
    leave: float = 0.0

    def used_by(self, settings: RolloutSettings) -> "Biases":
        """Leave out that of a decision that is not taken."""
        return Biases(
            add=self.add if settings.inserts else 0.0,
            leave=self.leave if settings.removes else 0.0,
        )

    def over(self, settings: RolloutSettings) -> RolloutSettings:
        """Add them to what the settings add themselves."""
        return replace(
            settings,
            add_bias=settings.add_bias + self.add,
            remove_bias=settings.remove_bias + self.leave,
        )


def write_found(folder: Path, biases: Biases) -> None:
    """Leave the biases that rollouts are to have."""
    write_json(folder / FOUND, asdict(biases))


def read_found(folder: Path) -> Biases:
    """Read the biases that rollouts are to have.

    Raises:
        StoreError: if the file is damaged.
    """
    path = folder / FOUND
    try:
        return Biases(**{k: float(v) for k, v in json.loads(path.read_text()).items()})
    except (ValueError, TypeError, AttributeError) as error:
        raise StoreError(
            f"{path} does not hold two biases ({error}); make it again: "
            "infgen run calibrate --force"
        ) from error


def read_biases(folder: Path) -> Biases:
    """Find the biases of weights from their log; none without a log or a validation."""
    path = folder / LOG
    lines = read_log(path) if path.is_file() else []
    found = [line["validation"] for line in lines if line.get("validation")]
    bins = found[-1] if found else {}
    return Biases(
        add=find_bias(bins["add_bins"]) if "add_bins" in bins else 0.0,
        leave=find_bias(bins["keep_bins"]) if "keep_bins" in bins else 0.0,
    )


def find_bias(bins: Mapping[str, Sequence[float] | Any]) -> float:
    """Find what makes the mean probability that of what happened.

    Args:
        bins: ``count``, and sums of probabilities (``predicted``) and of what ``happened``,
            by bin. All decisions of a bin count as if they had its mean probability.
    """
    count, predicted, happened = (
        np.asarray(bins[name], dtype=np.float64)
        for name in ("count", "predicted", "happened")
    )
    number, events = count.sum(), happened.sum()
    if number < FEWEST or min(events, number - events) < FEWEST / 10:
        return 0.0
    some = count > 0
    mean = np.clip(predicted[some] / count[some], 1e-9, 1 - 1e-9)
    odds, weight = np.log(mean / (1 - mean)), count[some] / number
    low, high = -LARGEST, LARGEST  # The rate grows with the bias: halve where it lies.
    for _ in range(_STEPS):
        middle = (low + high) / 2
        rate = (weight / (1 + np.exp(-(odds + middle)))).sum()
        low, high = (middle, high) if rate < events / number else (low, middle)
    return round(middle, 4)
