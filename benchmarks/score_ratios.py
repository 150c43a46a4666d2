"""Scores of one run as multiples of another's, scene by scene, with 95 % intervals.

Reads two finished stages ``score`` of a root, whatever their models are; ``run report
--preset`` compares what one command trained, this what was scored one by one::

    python benchmarks/score_ratios.py ROOT KEY KEY [--metrics ace/own_near ...]

Means over the scenes that both have are divided; scenes are drawn again, the same ones for
both. The last line is one JSON object.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import polars as pl
from jaxtyping import Float64

from infgen.metrics.intervals import bootstrap

METRICS = (
    "ace/own_near",
    "ace_slope/own_near",
    "ace/truth_near",
    "ace_slope/truth_near",
    "corrected/kinematic",
)
RESAMPLES, SEED = 2000, 0


def main() -> None:
    """Print each metric's ratio with its interval."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("root", type=Path, help="root with both scores")
    parser.add_argument("keys", nargs=2, help="keys of stage score: ours, theirs")
    parser.add_argument("--metrics", nargs="+", default=METRICS)
    asked = parser.parse_args()
    ours, theirs = (scene_means(asked.root / "store" / "score" / key) for key in asked.keys)
    both = ours.join(theirs, on=("scenario_id", "metric"), suffix="_theirs")
    found = {}
    for metric in asked.metrics:
        values = both.filter(metric=metric).select("value", "value_theirs").to_numpy()
        mean, low, high = (
            float(part[0]) for part in bootstrap(values, divided, RESAMPLES, SEED)
        )
        print(f"{metric:<24}{len(values):>6} scenes  {mean:.3f} ({low:.2f} to {high:.2f})")
        found[metric] = [mean, low, high]
    print(json.dumps(found))


def scene_means(folder: Path) -> pl.DataFrame:
    """Read each metric's mean over the rollouts of each scene."""
    table = pl.scan_parquet(folder / "scores.parquet")
    mean = pl.col("value").mean()
    # Sorted: which scenes are drawn again must not depend on the order of groups.
    return table.group_by("scenario_id", "metric").agg(mean).sort("scenario_id").collect()


def divided(
    means: Float64[np.ndarray, "resample 2"],
) -> Float64[np.ndarray, "resample 1"]:
    """Divide the first mean by the second."""
    return means[:, :1] / means[:, 1:]


if __name__ == "__main__":
    main()
