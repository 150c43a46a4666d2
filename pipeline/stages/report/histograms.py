"""How often each value occurs, in the logs and in the rollouts: charts and a table."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from infgen.metrics.long_term.protocols import FEATURES, PROTOCOLS, Feature
from infgen.metrics.long_term.reference import Counts
from infgen.views.charts.canvas import Chart
from infgen.views.charts.lines import Series, line_chart
from infgen.views.tables import Cell, Table
from pipeline.stages.reference_files import read_counts
from pipeline.stages.report.tables import FEATURES as WORDS

if TYPE_CHECKING:
    from pipeline.engine.stage import Inputs

DRAWN = "corrected"
"""Protocol of the charts: it counts values alike in logs and rollouts, and drops none."""
UNITS = {
    "linear_speed": "m/s",
    "linear_acceleration": "m/s2",
    "angular_speed": "rad/s",
    "angular_acceleration": "rad/s2",
    "distance_to_nearest_object": "m",
    "time_to_collision": "s",
    "distance_to_road_edge": "m, on the road below 0",
    "num_entries": "agents",
    "num_exits": "agents",
    "entry_distance": "m to the ego",
    "exit_distance": "m to the ego",
}


def read_both(inputs: "Inputs") -> tuple[Counts, Counts]:
    """Read the counts of all logs, and of all rollouts."""
    return read_counts(inputs.folder("reference")), read_counts(inputs.folder("score"))


def charts(logs: Counts, played: Counts) -> list[Chart]:
    """Draw each feature's histogram: the logs' and the rollouts'."""
    at = next(i for i, protocol in enumerate(PROTOCOLS) if protocol.name == DRAWN)
    return [
        _chart(feature, logs.bins[at, row], played.bins[at, row])
        for row, feature in enumerate(FEATURES)
    ]


def _chart(feature: Feature, logs: np.ndarray, played: np.ndarray) -> Chart:
    edges = feature.histogram.edges.astype(np.float64)
    lines = []
    for name, counts in (("rollouts", played), ("logs", logs)):
        share = _shares(counts[: feature.histogram.bins])
        lines.append(Series(name, np.repeat(edges, 2)[1:-1], np.repeat(share, 2)))
    return line_chart(
        lines,
        title=f"{WORDS[feature.name][0].upper()}{WORDS[feature.name][1:]}",
        x_label=UNITS.get(feature.name, "0: no, 1: yes"),
        y_label="share",
    )


def _shares(counts: np.ndarray) -> np.ndarray:
    """Share of each bin; unknown where nothing was counted."""
    total = counts.sum()
    return counts / total if total else np.full(len(counts), np.nan)


def table(logs: Counts, played: Counts) -> Table:
    """List every bin of every feature under both protocols."""
    rows: list[Sequence[Cell]] = []
    for at, protocol in enumerate(PROTOCOLS):
        for row, feature in enumerate(FEATURES):
            edges = feature.histogram.edges.tolist()
            for place in range(feature.histogram.bins):
                counts = [int(each.bins[at, row, place]) for each in (logs, played)]
                ends = edges[place], edges[place + 1]
                rows.append([feature.name, protocol.name, *ends, *counts])
    columns = ["feature", "protocol", "from", "to", "logs", "rollouts"]
    return Table("Histograms", columns, rows)
