"""Fair scores of an ensemble against what happened: CRPS, energy score, skill.

Fair means corrected for the size of the ensemble: the expectation does not depend on the
number of members, and is least where members are drawn from the distribution that the truth
is drawn from (Ferro 2014, doi:10.1002/qj.2270; Gneiting and Raftery 2007,
doi:10.1198/016214506000001437). Less is better; the fair scores may be below 0.
"""

import numpy as np
from jaxtyping import Float64


def fair_crps(
    members: Float64[np.ndarray, "member ..."], truth: Float64[np.ndarray, "*shape"]
) -> Float64[np.ndarray, "*shape"]:
    """Give the continuous ranked probability score of each number.

    ``mean |x_i - y| - sum |x_i - x_j| / (2 M (M - 1))``; NaN where the truth or a member is
    not known, and with fewer than two members.
    """
    count = len(members)
    if count < 2:
        return np.full(truth.shape, np.nan)
    error = np.abs(members - truth).mean(axis=0)
    rank = 2.0 * np.arange(count) - count + 1
    # Over sorted members, each pair once: half the sum over ordered pairs.
    spread = np.tensordot(rank, np.sort(members, axis=0), axes=(0, 0))
    return np.asarray(error - spread / (count * (count - 1)))


def fair_energy(
    members: Float64[np.ndarray, "member *shape part"],
    truth: Float64[np.ndarray, "*shape part"],
) -> Float64[np.ndarray, "*shape"]:
    """Give the energy score of each vector: the same with Euclidean distances.

    With one part it is the CRPS. NaN where ``fair_crps`` is.
    """
    count = len(members)
    if count < 2:
        return np.full(truth.shape[:-1], np.nan)
    error = np.linalg.norm(members - truth, axis=-1).mean(axis=0)
    spread = np.zeros_like(error)
    for at in range(1, count):  # One pair each, without an array of all pairs.
        spread += np.linalg.norm(members[at:] - members[:-at], axis=-1).sum(axis=0)
    return np.asarray(error - spread / (count * (count - 1)))


def point_energy(
    forecast: Float64[np.ndarray, "*shape part"], truth: Float64[np.ndarray, "*shape part"]
) -> Float64[np.ndarray, "*shape"]:
    """Give the energy score of a forecast that is certain: its distance to the truth."""
    return np.linalg.norm(forecast - truth, axis=-1)


def skill(
    score: Float64[np.ndarray, "*shape"], reference: Float64[np.ndarray, "*shape"]
) -> Float64[np.ndarray, "*shape"]:
    """Give ``1 - score / reference`` of mean scores: 1 at best, 0 as good as the reference.

    NaN where the reference makes no error, so that nothing can be gained on it.
    """
    known = reference > 0
    return np.where(known, 1 - score / np.where(known, reference, 1), np.nan)
