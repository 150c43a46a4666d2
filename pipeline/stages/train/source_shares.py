"""Shares of sources in training: setting ``train.source_share``."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Int64

from infgen.errors import ConfigError
from pipeline.stages.train.sampler import Mixture

DRAWS_OF_RAREST = 100
"""A round holds at least so many scenes of the rarest source: shares are right to 1 %."""


def read_shares(words: str) -> dict[str, float]:
    """Read sources and their shares, of any sum, from the setting's ``source:share,...``.

    Raises:
        ConfigError: naming a source that is named twice.
    """
    shares: dict[str, float] = {}
    for word in words.split(",") if words else ():
        name, _, share = word.strip().partition(":")
        if name in shares:
            raise ConfigError(f"train.source_share names {name} twice")
        shares[name] = float(share)
    return shares


def check_shares(shares: Mapping[str, float], sources: Sequence[str]) -> None:
    """Refuse shares of other sources than there are.

    Raises:
        ConfigError: naming the source.
    """
    there = sorted(set(sources))
    for name in shares:
        if name not in there:
            raise ConfigError(
                f"train.source_share names {name}, but the training split has "
                f"{', '.join(there) or 'no source'}"
            )
    for name in there:
        if name not in shares:
            raise ConfigError(
                f"train.source_share gives {name} no share; add {name}:0 to leave it out"
            )
    if not any(shares.values()):
        raise ConfigError("train.source_share leaves out every source")


def mix(
    shares: Mapping[str, float], sources: Sequence[str], counts: Sequence[int]
) -> Mixture:
    """Say how many scenes of each source a round has.

    Args:
        shares: Of all sources there are.
        sources: Source of each token shard.
        counts: Scenes of each token shard, whose rows follow each other.

    Raises:
        ConfigError: if a source that has a share has no scenes.
    """
    of_row = np.repeat(np.array(sources), np.array(counts, np.int64))
    names = sorted(name for name in shares if shares[name] > 0)
    rows = [np.flatnonzero(of_row == name) for name in names]
    for name, some in zip(names, rows, strict=True):
        if not len(some):
            raise ConfigError(
                f"train.source_share gives {name} a share, but it has no scenes"
            )
    share = np.array([shares[name] for name in names]) / sum(shares.values())
    length = max(len(of_row), int(np.ceil(DRAWS_OF_RAREST / share.min())))
    return Mixture(tuple(rows), tuple(_apportion(share, length).tolist()))


def _apportion(share: np.ndarray, length: int) -> Int64[np.ndarray, " source"]:
    """Cut a length by shares; what rounding leaves goes to the largest remainders."""
    exact = share * length
    counts = np.floor(exact).astype(np.int64)
    left = length - int(counts.sum())
    counts[np.argsort(counts - exact, kind="stable")[:left]] += 1
    return counts
