"""Do numbers of agents that enter and leave vary as those of independent decisions?

Logs, token step by token step as they are learned from, and what some weights expect::

    python benchmarks/rate_variation.py ROOT [--weights ROOT/latest/train]
        [--split validation] [--scenes 80]

For insertions and removals the table has how many there were and how many were expected,
and the dispersion: the mean over scenes of the squared difference of the two, divided by
the variance of independent decisions (1 if they are independent). Then the negative
log-likelihood of a scene, in nats: of independent decisions; under the latent rates of the
weights (``model.latent_rates``), if they have any; and under the likeliest of a grid of
latent rates, which is named. The last line is one JSON object.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64
from logged_scenes import sum_over_logs, whole

from infgen.model.batching.batch import Batch
from infgen.model.latent_rates import Rate, RateProcess
from infgen.model.logits import Outputs
from infgen.model.network import Network
from infgen.model.training.diagnostics import decisions
from infgen.model.training.losses import losses
from infgen.model.training_settings import TrainSettings
from infgen.tokens.scene_tokens import SceneTokens
from pipeline.commands.screen import show_table

TERMS = {Rate.INSERTION: "add", Rate.REMOVAL: "keep"}
"""Terms of the loss, by what is decided."""
GRID = tuple(itertools.product((0.3, 0.5, 0.7, 0.9, 1.2), (0.0, 0.5, 0.8, 0.9, 0.95)))
"""Scales and persistences. Means are those at which as many are expected as without."""
FIGURES = ("scenes", "events", "expected", "dispersion", "independent", "latent")


def look(network: Network, scene: SceneTokens) -> Float64[np.ndarray, "kind figure"]:
    """Find the figures of a scene, by ``Rate``: ``FIGURES``, then nats of the grid."""
    batch = whole(network, scene)
    with torch.no_grad():
        outputs = network(batch)
        if outputs.entries is None or outputs.motion.remove_logit is None:
            raise SystemExit("these weights do not insert and remove; see --weights")
        made = decisions(outputs, batch)
        independent = _nats(outputs, batch, None)
        latent = independent
        if outputs.rates is not None:
            latent = _nats(outputs, batch, outputs.rates)
        of_grid = [_nats(outputs, batch, _process(*each)) for each in GRID]
    found = np.zeros((len(Rate), len(FIGURES) + len(GRID)))
    for rate, name in TERMS.items():
        probability, happened = (each.double().numpy() for each in made[name])
        events, expected = happened.sum(), probability.sum()
        dispersion = (events - expected) ** 2 / (probability * (1 - probability)).sum()
        nats = [independent[rate], latent[rate], *(each[rate] for each in of_grid)]
        found[rate] = [1, events, expected, dispersion, *nats]
    return found


def _process(scale: float, persistence: float) -> RateProcess:
    """Return a process, the same for both kinds."""
    each = (-(scale**2) / 4, scale, persistence)
    return RateProcess(*(torch.full((2,), value) for value in each))


def _nats(outputs: Outputs, batch: Batch, rates: RateProcess | None) -> dict[Rate, float]:
    """Return the negative log-likelihood of a scene's decisions, by kind."""
    terms = losses(replace(outputs, rates=rates), batch, TrainSettings())
    return {rate: float(terms[name].loss) for rate, name in TERMS.items()}


def report(found: Float64[np.ndarray, "kind figure"]) -> list[dict[str, object]]:
    """Print the table; return its rows."""
    rows: list[dict[str, object]] = []
    for rate in Rate:
        scenes, events, expected, dispersion, independent, latent, *of_grid = found[rate]
        best = int(np.argmin(of_grid))
        rows.append(
            {
                "decision": rate.name.lower(),
                "events": round(events / scenes, 2),
                "expected": round(expected / scenes, 2),
                "dispersion": round(dispersion / scenes, 2),
                "independent_nats": round(independent / scenes, 2),
                "latent_nats": round(latent / scenes, 2),
                "best_of_grid_nats": round(of_grid[best] / scenes, 2),
                "scale": GRID[best][0],
                "persistence": GRID[best][1],
            }
        )
    show_table(
        "insertions and removals of a scene",
        tuple(name.replace("_", " ") for name in rows[0]),
        [tuple(map(str, row.values())) for row in rows],
    )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Look at the logs of a root's tokens."""
    sum_over_logs(__doc__, arguments, look, report)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
