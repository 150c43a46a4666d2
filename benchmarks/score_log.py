"""Score the log itself, the log with noise, and kept velocity: the scorer's own check.

All shared validation records (or the built-in ones), both long-term protocols and the Waymo
metric; prints the tables of ``docs/`` as Markdown::

    python benchmarks/score_log.py [--scenes N] [--rollouts N] [--splits training ...]

The last line is one JSON object with the composites and metametrics.
"""

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice

import numpy as np
from futures import (
    constant_velocity,
    kept_velocity,
    logged_future,
    noisy_future,
    noisy_traffic,
)
from records import read_split

from infgen.config import ReferenceSettings, TokenSettings
from infgen.metrics.agent_count import mean_counts
from infgen.metrics.intervals import scene_mean
from infgen.metrics.long_term.binned import Binned, bin_traffic
from infgen.metrics.long_term.protocols import FEATURES, PROTOCOLS
from infgen.metrics.long_term.reference import (
    Counts,
    count_log,
    count_simulated,
    divergence,
    log_probabilities,
    no_counts,
)
from infgen.metrics.long_term.table import Against, LogCounts, make_row, named
from infgen.metrics.traffic import Traffic, from_log
from infgen.metrics.windows import Windows, cut_windows
from infgen.metrics.wosac import metric
from infgen.metrics.wosac.logged import FUTURE_STEPS
from infgen.scene import Scene
from infgen.spatial.road_edges import scene_road_edges

LONG_STEPS = 300
VERSIONS = ("wosac-2025", "wosac-2024")
PLAYERS: Mapping[str, Callable[[Traffic], Traffic]] = {
    "log": lambda traffic: traffic,
    "log + noise": lambda traffic: noisy_traffic(traffic, seed=0),
    "kept velocity": lambda traffic: kept_velocity(traffic, FUTURE_STEPS),
    "kept velocity, 30 s": lambda traffic: kept_velocity(traffic, LONG_STEPS),
}
SHARED_NUMBERS = ("agents/near", "ace/own_near", "ace_slope/own_near", "ace/split_near")


@dataclass
class LongTerm:
    """Everything measured for the long-term tables."""

    logged: Counts = field(default_factory=no_counts)
    logs: dict[str, LogCounts] = field(default_factory=dict)
    binned: dict[str, list[Binned]] = field(default_factory=dict)
    counts: dict[str, Counts] = field(default_factory=dict)

    def take(self, scene: Scene) -> None:
        """Measure a scene, if it can be measured."""
        try:
            traffic = from_log(scene, TokenSettings())
        except ValueError:
            return
        edges, radius_m = scene_road_edges(scene), ReferenceSettings().count_radius_m
        log = bin_traffic(traffic, edges, radius_m, as_logged=True)
        if not _windows(log).count:
            return
        self.logged += count_log(log, _windows(log))
        self.logs[scene.scenario_id] = LogCounts(log.num_near, log.num_all)
        for name, play in PLAYERS.items():
            one = bin_traffic(play(traffic), edges, radius_m, as_logged=False)
            self.binned.setdefault(name, []).append(one)
            counts = count_simulated(one, _windows(one))
            self.counts[name] = self.counts.get(name, no_counts()) + counts

    def against(self) -> Against:
        """What all are scored against."""
        means = [
            [mean_counts(n, _cut(len(n)))[0] for n in (log.near, log.all)]
            for log in self.logs.values()
        ]
        near, everyone = np.mean(means, axis=0)
        return Against(
            log_p=log_probabilities(self.logged),
            split_near=float(near),
            split_all=float(everyone),
            logs=self.logs,
            window_s=ReferenceSettings().window_s,
            stride_s=ReferenceSettings().stride_s,
        )

    def columns(self) -> dict[str, dict[str, float]]:
        """Mean over scenes of every number, by player."""
        against = self.against()
        return {
            name: _mean([make_row(one, against).numbers for one in binned])
            for name, binned in self.binned.items()
        }


def _windows(binned: Binned) -> Windows:
    return _cut(binned.bins.shape[-1])


def _cut(num_steps: int) -> Windows:
    return cut_windows(
        num_steps, ReferenceSettings().window_s, ReferenceSettings().stride_s
    )


def _mean(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Means over scenes; buckets and composites follow from the features' means."""
    values = np.array([list(row.values()) for row in rows])
    mean = dict(zip(rows[0], scene_mean(values, np.ones((1, len(rows))))[0], strict=True))
    for protocol in PROTOCOLS:
        names = [f"{protocol.name}/{feature.name}" for feature in FEATURES]
        features = np.array([[mean[name] for name in names]])
        mean |= {f"{protocol.name}/{k}": float(v[0]) for k, v in named(features)}
    return {name: float(value) for name, value in mean.items()}


def score_wosac(
    scenes: Sequence[Scene], rollouts: int
) -> dict[str, dict[str, metric.Scores]]:
    """Mean official scores by player and version."""
    found: dict[str, dict[str, list[metric.Scores]]] = {}
    for at, scene in enumerate(scenes):
        try:
            log = metric.from_scene(scene)
            futures = {
                "log": logged_future(log, rollouts),
                "log + noise": noisy_future(log, rollouts, seed=at),
                "kept velocity": constant_velocity(log, rollouts),
            }
            scores = {
                name: metric.score_versions(log, future, VERSIONS)
                for name, future in futures.items()
            }
        except ValueError as error:
            print(f"<!-- left out: {error} -->")
            continue
        for name, of_scene in scores.items():
            for one in of_scene:
                found.setdefault(name, {}).setdefault(one.version, []).append(one)
    return {
        name: {version: metric.mean_scores(all_) for version, all_ in of_player.items()}
        for name, of_player in found.items()
    }


def print_table(columns: Mapping[str, Mapping[str, float]], names: Sequence[str]) -> None:
    """Print numbers as a Markdown table."""
    print("| | " + " | ".join(columns) + " |")
    print("|---|" + "---:|" * len(columns))
    for name in names:
        cells = (f"{column.get(name, np.nan):.4f}" for column in columns.values())
        print(f"| {name} | " + " | ".join(cells).replace("nan", "-") + " |")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables and the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", type=int, default=0, help="at most so many; 0 for all")
    parser.add_argument("--rollouts", type=int, default=32, help="of the Waymo metric")
    parser.add_argument(
        "--splits",
        nargs="+",
        default=["validation"],
        help="starts of file names, or *; with a slash, patterns of paths",
    )
    options = parser.parse_args(arguments)
    found = chain.from_iterable(read_split(split) for split in options.splits)
    scenes = list(islice(found, options.scenes or None))
    long_term = LongTerm()
    for scene in scenes:
        long_term.take(scene)
    columns = long_term.columns()
    labels = [name for name, _ in named(np.zeros((1, len(FEATURES))))]
    for at, protocol in enumerate(PROTOCOLS):
        print(f"\nLong-term, protocol `{protocol.name}`, {len(long_term.logs)} scenes\n")
        names = [*labels, "collision_rate", "offroad_rate"]
        print_table(columns, [f"{protocol.name}/{name}" for name in names])
        print(f"\nJensen-Shannon divergence in bits, `{protocol.name}`\n")
        apart = {
            n: divergence(long_term.logged, c)[at] for n, c in long_term.counts.items()
        }
        table = {
            n: dict(zip([f.name for f in FEATURES], v, strict=True))
            for n, v in apart.items()
        }
        print_table(table, [feature.name for feature in FEATURES])
    print("\nAgents and ACE\n")
    print_table(columns, SHARED_NUMBERS)
    official = score_wosac(scenes, options.rollouts)
    for version in VERSIONS:
        print(f"\n{version}, {options.rollouts} rollouts\n")
        numbers = {name: scores[version].numbers() for name, scores in official.items()}
        print_table(numbers, list(next(iter(numbers.values()))))
    figures = {
        **{
            f"{protocol.name} {name}": round(column[f"{protocol.name}/composite"], 4)
            for protocol in PROTOCOLS
            for name, column in columns.items()
        },
        **{
            f"{version} {name}": round(scores[version].metametric, 4)
            for name, scores in official.items()
            for version in VERSIONS
        },
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
