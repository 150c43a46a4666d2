"""How many come and go with which biases, and the biases with which it is right.

Surfaces are fitted to simulations of the same scenes with different biases: logarithms of
entries, exits and the number of agents, quadratic in the bias of insertion (where more
enter, more can leave), linear in that of leaving. Where all three are those of the logs, a
scene lives on as it began.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from infgen.metrics.flow import FlowCounts
from pipeline.stages.calibration import Biases

DESIGN = ((0.0, 0.0), (0.5, -1.0), (0.5, 0.0), (0.5, 1.0), (1.0, 0.0))
"""Biases of insertion and removal of each simulation, relative to the start, in ranges."""
BEYOND = 0.5
"""The best biases may lie this many ranges outside of those simulated."""
FINE = 0.01
"""What is found is a multiple of this (in reaches) away from the odds' own."""
FEWEST = 20
"""Fewer entries or exits, in the logs or in any simulation, decide nothing."""
EASE = 1e-3
"""Squared reaches away from the odds that weigh as much as a squared error of the logs."""


@dataclass(frozen=True, slots=True)
class Reach:
    """The biases of the simulations: their centre and range."""

    around: Biases
    add: float
    leave: float

    def at(self, add: float, leave: float) -> Biases:
        """Biases of a point, which is given in reaches; as they are written."""
        return Biases(
            add=round(self.around.add + add * self.add, 4),
            leave=round(self.around.leave + leave * self.leave, 4),
        )


@dataclass(frozen=True, slots=True)
class Best:
    """The biases found.

    Attributes:
        biases: Add to the log-odds.
        came: Expected entries, as a multiple of those of the logs.
        went: The same for exits; None where there were too few.
        agents: The same for the number of agents.
        at_the_end: Whether they lie at an end of what may be: better ones lie beyond.
    """

    biases: Biases
    came: float
    went: float | None
    agents: float | None
    at_the_end: bool


def find_best(plays: Sequence[FlowCounts], logs: FlowCounts, reach: Reach) -> Best | None:
    """Find the biases with which entries, exits and agent counts match the logs.

    Args:
        plays: Counts of the simulations at each point of ``DESIGN``.
        logs: What did in the logs of the same scenes.
        reach: Where the points lie.

    Returns:
        None if too few came to tell. Where it makes no difference, the bias of leaving
        stays nearly that of the odds.
    """
    points = _lattice()
    off = {
        name: _off(name, points, plays, logs)
        for name in ("came", "went", "agents")
        if min(getattr(counts, name) for counts in (logs, *plays)) >= FEWEST
    }
    if "came" not in off:
        return None
    errors = sum(one**2 for one in off.values()) + EASE * (points**2).sum(axis=1)
    at = int(errors.argmin())
    end = (points[at] == points.min(axis=0)) | (points[at] == points.max(axis=0))
    times = {name: round(float(np.exp(one[at])), 4) for name, one in off.items()}
    return Best(
        biases=reach.at(*points[at].tolist()),
        came=times["came"],
        went=times.get("went"),
        agents=times.get("agents"),
        at_the_end=bool(end.any()),
    )


def _off(
    name: str,
    points: Float64[np.ndarray, "point 2"],
    plays: Sequence[FlowCounts],
    logs: FlowCounts,
) -> Float64[np.ndarray, " point"]:
    """Logarithm of a count at points, as a multiple of the logs'."""
    rates = [counts.per_token(getattr(counts, name)) for counts in (logs, *plays)]
    return _terms(points) @ _surface(np.array(DESIGN), rates[1:]) - np.log(rates[0])


def _surface(
    design: Float64[np.ndarray, "play 2"], rates: Sequence[float]
) -> Float64[np.ndarray, "4"]:
    """Fit the logarithms of rates; one simulation more than terms."""
    found, *_ = np.linalg.lstsq(_terms(design), np.log(rates), rcond=None)
    return found


def _terms(points: Float64[np.ndarray, "point 2"]) -> Float64[np.ndarray, "point 4"]:
    add, leave = points.T
    return np.stack([np.ones_like(add), add, add**2, leave], axis=1)


def _lattice() -> Float64[np.ndarray, "point 2"]:
    """All biases that may be found, in reaches."""
    low = np.rint((np.min(DESIGN, axis=0) - BEYOND) / FINE)
    high = np.rint((np.max(DESIGN, axis=0) + BEYOND) / FINE)
    sides = [FINE * np.arange(*ends) for ends in zip(low, high + 1, strict=True)]
    add, leave = np.meshgrid(*sides, indexing="ij")
    return np.stack([add.ravel(), leave.ravel()], axis=1)
