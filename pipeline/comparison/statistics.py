"""Numbers of several runs: means over seeds, and how one method stands to another."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from infgen.metrics.intervals import bootstrap
from infgen.metrics.long_term.protocols import FEATURES, PROTOCOLS
from infgen.metrics.long_term.table import named
from infgen.views.sheets import Measured
from pipeline.comparison.scores import Scored
from pipeline.stages.score.summary import Tally

_T_975 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
"""Student's t that 97.5 % lie below, by degrees of freedom from 1."""
_Z_975 = 1.959964

Numbers = Mapping[tuple[str, str], Mapping[str, Measured]]
"""Numbers by name, by arm and rollout set."""


def student_t(degrees: int) -> float:
    """Half width of a 95 % interval in standard errors of the mean.

    Args:
        degrees: Of freedom: one less than there are values.
    """
    if degrees <= len(_T_975):
        return _T_975[degrees - 1]
    z, n = _Z_975, degrees  # Cornish and Fisher's expansion, good to 0.0002 from here on.
    first = (z**3 + z) / 4
    second = (5 * z**5 + 16 * z**3 + 3 * z) / 96
    third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
    return z + first / n + second / n**2 + third / n**3


def over_seeds(values: Sequence[Measured]) -> Measured:
    """Give the mean over seeds with its Student-t interval.

    One value keeps the interval that it has; of those that are not known none counts.
    """
    known = [value.mean for value in values if value.mean is not None]
    if len(known) < 2:
        return next((v for v in values if v.mean is not None), Measured(None))
    mean, error = float(np.mean(known)), np.std(known, ddof=1) / np.sqrt(len(known))
    half = float(student_t(len(known) - 1) * error)
    return Measured(mean, mean - half, mean + half)


def combine(scored: Sequence[Scored]) -> Numbers:
    """Give every arm's and rollout set's numbers over their seeds."""
    groups: dict[tuple[str, str], list[Scored]] = {}
    for one in scored:
        groups.setdefault((one.arm, one.rollout_set), []).append(one)
    return {
        key: {
            name: over_seeds([one.numbers[name] for one in some if name in one.numbers])
            for name in dict.fromkeys(name for one in some for name in one.numbers)
        }
        for key, some in groups.items()
    }


def ratio(ours: Sequence[Scored], theirs: Sequence[Scored], name: str) -> Measured:
    """Give one number of an arm as a multiple of another arm's, seed by seed.

    With one seed the interval is that of drawing scenes again, the same ones for both.

    Args:
        ours: Runs of one rollout set of one arm.
        theirs: The same of the other.
        name: Of the number.
    """
    beside = {one.seed: one for one in theirs}
    pairs = [(one, beside[one.seed]) for one in ours if one.seed in beside]
    return over_seeds([_ratio(*pair, name) for pair in pairs])


def _ratio(ours: Scored, theirs: Scored, name: str) -> Measured:
    names, follow = _parts(name)
    scenes = [scene for scene in ours.tally.means if scene in theirs.tally.means]
    if not scenes:
        return Measured(None)
    values = np.concatenate(
        [_values(one.tally, scenes, names) for one in (ours, theirs)], axis=1
    )

    def divide(means: np.ndarray) -> np.ndarray:
        above, below = follow(means[:, : len(names)]), follow(means[:, len(names) :])
        return np.where(below != 0, above / np.where(below != 0, below, 1), np.nan)[:, None]

    settings = ours.settings
    found = bootstrap(values, divide, settings.bootstrap_resamples, settings.seed)
    return Measured(*[_known(float(part[0])) for part in found])


def truth(logs: Tally, name: str) -> float | None:
    """Mean of one number over logs; None where no log has it."""
    names, follow = _parts(name)
    if not logs.means:
        return None
    values = _values(logs, list(logs.means), names)
    known = ~np.isnan(values)
    count = known.sum(axis=0)
    mean = np.where(known, values, 0).sum(axis=0) / np.where(count > 0, count, 1)
    mean = np.where(count > 0, mean, np.nan)
    return _known(float(follow(mean[None])[0]))


def mean_curve(curves: Sequence[np.ndarray]) -> Float64[np.ndarray, " window"]:
    """Mean over seeds in each window, of those that reach so far and have a value there."""
    length = max(len(curve) for curve in curves)
    padded = np.full((len(curves), length), np.nan)
    for row, curve in zip(padded, curves, strict=True):
        row[: len(curve)] = curve
    known = ~np.isnan(padded)
    total, count = np.where(known, padded, 0).sum(axis=0), known.sum(axis=0)
    return np.where(count > 0, total / np.where(count > 0, count, 1), np.nan)


def _parts(name: str) -> tuple[list[str], Callable[[np.ndarray], np.ndarray]]:
    """Name what a number follows from, and say how: composites follow from features."""
    protocol, _, label = name.partition("/")
    labels = [label for label, _ in named(np.zeros((1, len(FEATURES))))]
    if protocol not in [each.name for each in PROTOCOLS] or label not in labels:
        return [name], lambda means: means[:, 0]
    at = labels.index(label)
    features = [f"{protocol}/{feature.name}" for feature in FEATURES]
    return features, lambda means: [value for _, value in named(means)][at]


def _values(tally: Tally, scenes: Sequence[str], names: Sequence[str]) -> np.ndarray:
    """Means [scene, number]; NaN where a scene has none."""
    rows = [[tally.means[each].get(name, np.nan) for name in names] for each in scenes]
    return np.array(rows, dtype=np.float64)


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value
