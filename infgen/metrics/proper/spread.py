"""Does the spread of an ensemble tell its error: rank histogram and spread-skill ratio."""

import numpy as np
from jaxtyping import Float64


def rank_counts(
    members: Float64[np.ndarray, "member value"], truth: Float64[np.ndarray, " value"]
) -> Float64[np.ndarray, " rank"]:
    """Count the ranks of truths among their members: flat where both are drawn alike.

    A truth that equals some members has each of the ranks it could have in equal parts
    (Hamill 2001). Truths that are not known have no rank.
    """
    count = len(members)
    counts = np.zeros(count + 1)
    known = ~np.isnan(truth) & ~np.isnan(members).any(axis=0)
    lower = (members[:, known] < truth[known]).sum(axis=0)
    equal = (members[:, known] == truth[known]).sum(axis=0)
    for rank in range(count + 1):
        within = (rank >= lower) & (rank <= lower + equal)
        counts[rank] = (within / (equal + 1)).sum()
    return counts


def flatness_error(
    counts: Float64[np.ndarray, "*shape rank"],
) -> Float64[np.ndarray, "*shape"]:
    """Give ``sum |share - 1 / ranks|``: 0 for a flat histogram, nearly 2 for one rank.

    The reliability index of Delle Monache et al. (2006); NaN where there are no counts.
    """
    total = counts.sum(axis=-1, keepdims=True)
    share = np.where(total > 0, counts / np.where(total > 0, total, 1), np.nan)
    return np.abs(share - 1 / counts.shape[-1]).sum(axis=-1)


def spread_and_error(
    members: Float64[np.ndarray, "member ..."], truth: Float64[np.ndarray, "*shape"]
) -> tuple[Float64[np.ndarray, "*shape"], Float64[np.ndarray, "*shape"]]:
    """Give the variance that the error of the mean should have, and its square.

    ``(M + 1) / M`` times the unbiased variance of the members, and ``(mean - truth)^2``:
    equal in expectation where members and truth are drawn alike (Fortin et al. 2014,
    doi:10.1175/JHM-D-14-0008.1). NaN with fewer than two members.
    """
    count = len(members)
    if count < 2:
        nothing = np.full(truth.shape, np.nan)
        return nothing, nothing
    expected = np.asarray((count + 1) / count * members.var(axis=0, ddof=1))
    error = np.asarray((members.mean(axis=0) - truth) ** 2)
    return np.where(np.isnan(error), np.nan, expected), error


def spread_skill(
    variance: Float64[np.ndarray, "*shape"], error: Float64[np.ndarray, "*shape"]
) -> Float64[np.ndarray, "*shape"]:
    """Give the ratio of spread to error from mean squares: 1 where both agree.

    Below 1 the ensemble is too sure, above 1 not sure enough; NaN without any error.
    """
    known = error > 0
    return np.where(known, np.sqrt(variance / np.where(known, error, 1)), np.nan)
