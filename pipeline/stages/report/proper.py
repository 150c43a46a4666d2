"""Protocol ``proper`` in the report: its tables, and charts of windows and ranks."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from infgen.metrics.proper.engineering.measure import SCALES
from infgen.metrics.proper.quantities import QUANTITIES
from infgen.views.charts.canvas import Chart
from infgen.views.charts.lines import Series, line_chart
from infgen.views.tables import Cell, Table, words
from pipeline.stages.report.tables import BUCKETS, COMPOSITES, FEATURES

COUNTS = {
    "energy": "all counts by type and ring (energy score)",
    "vehicles": "vehicles",
    "pedestrians": "pedestrians",
    "cyclists": "cyclists",
    "entries": "entries",
    "exits": "exits",
    "entry_distance": "distance at entry",
}
"""Words for what is counted around the ego."""
TRAFFIC = {
    "speed": "speed",
    "acceleration": "acceleration",
    "time_headway": "time headway",
    "post_encroachment_time": "post-encroachment time",
    "stop_duration": "stop duration",
    "setting_off_delay": "setting-off delay at green",
    "length_of_stay": "length of stay",
    "turn_at_junction": "turn at junctions",
    "lane_density": "density of lanes",
    "lane_flow": "flow of lanes",
    "lane_speed": "speed of lanes",
}
"""Words for what traffic engineers read."""
_NOT_MEASURED = "not measured"


def proper_tables(summary: Mapping[str, Any]) -> list[Table]:
    """All tables of the protocol; none where nothing was scored by it."""
    found = summary.get("proper", {})
    if not found.get("scenes"):
        return []
    return [_counts(found), _likelihoods(found), _traffic(found)]


def proper_charts(summary: Mapping[str, Any], curves: Path) -> list[Chart]:
    """Draw the energy score along the rollouts, and the ranks of the truth."""
    found = summary.get("proper", {})
    if not found.get("scenes"):
        return []
    lines = _lines(curves, float(found["window_s"]))
    energy = {
        "model": "rollouts",
        "persistence": "as many as now",
        "climatology": "distribution of the split",
    }
    drawn = [
        _chart(
            [
                Series(label, lines[f"{name}/energy"].x, lines[f"{name}/energy"].y)
                for name, label in energy.items()
                if f"{name}/energy" in lines
            ],
            title="Energy score of counts by window (proper)",
            x_label="middle of the window, s after now",
            y_label="agents",
        )
    ]
    ranks = [
        Series(COUNTS[name], np.arange(len(shares), dtype=np.float64), np.array(shares))
        for name in QUANTITIES
        if (shares := found["ranks"][name])
    ]
    most = max((len(line.x) for line in ranks), default=0)
    flat = Series(
        "as it should be",
        np.arange(most, dtype=np.float64),
        np.full(most, 1 / max(1, most)),
    )
    drawn.append(
        _chart(
            ranks,
            flat,
            title="Ranks of the truth among the rollouts (proper)",
            x_label="rollouts below the truth",
            y_label="share",
        )
    )
    return [chart for chart in drawn if chart is not None]


def _counts(found: Mapping[str, Any]) -> Table:
    rows: list[Sequence[Cell]] = []
    for name, label in COUNTS.items():
        cells: list[Cell] = [label, *_cells(found, name)]
        cells += _cells(found, f"skill_persistence/{name}")
        cells += _cells(found, f"skill_climatology/{name}")
        cells += [_mean(found, f"{part}/{name}") for part in _SINGLE]
        rows.append(cells)
    return Table(
        title="Proper scores of counts around the ego",
        columns=[
            "what",
            "fair score",
            "95 % interval",
            "skill over as many as now",
            "interval",
            "skill over the split's distribution",
            "interval of it",
            *_SINGLE.values(),
        ],
        rows=rows,
        note=f"{_about(found)} Scores: less is better, and skill 1 is best, 0 as good as "
        "the reference. Spread over error is 1 where rollouts are as unsure as they should "
        "be, rank error 0. Skill over motion only stands in tables of comparisons.",
    )


_EVENTS = {"num_entries": "entries per window", "num_exits": "exits per window"}
_SINGLE = {
    "context": "against logs of like situations",
    "spread_skill": "spread over error",
    "rank_error": "rank error",
}


def _likelihoods(found: Mapping[str, Any]) -> Table:
    rows = [
        [label, *_cells(found, f"likelihood/{name}")]
        for name, label in {**COMPOSITES, **BUCKETS, **FEATURES, **_EVENTS}.items()
    ]
    return Table(
        title="Likelihood of the logs under their rollouts (proper)",
        columns=["feature", "likelihood", "95 % interval"],
        rows=rows,
        note=f"{_about(found)} More is better. An agent that is gone is an outcome of its "
        "own, so leaving too early or too late counts.",
    )


def _traffic(found: Mapping[str, Any]) -> Table:
    rows = [
        [TRAFFIC[scale.name], scale.unit, *_cells(found, f"w1/{scale.name}")]
        for scale in SCALES
    ]
    return Table(
        title="Traffic as engineers judge it: rollouts against their logs (proper)",
        columns=["what", "unit", "Wasserstein-1 distance", "95 % interval"],
        rows=rows,
        note=f"{_about(found)} Less is better, 0 best, in the unit of each row. What "
        "no log or no rollout shows is not measured.",
    )


def _about(found: Mapping[str, Any]) -> str:
    horizon_s = found["windows"] * found["window_s"]
    return (
        f"{found['scenes']} scenes, windows of {found['window_s']:g} s side by side, up to "
        f"{horizon_s:g} s after now."
    )


def _cells(found: Mapping[str, Any], name: str) -> list[Cell]:
    entry = found["numbers"].get(name, {})
    mean, low, high = (entry.get(field) for field in ("mean", "low", "high"))
    if mean is None:
        return [_NOT_MEASURED, None]
    known = low is not None and high is not None
    return [mean, f"{words(low)} to {words(high)}" if known else None]


def _mean(found: Mapping[str, Any], name: str) -> Cell:
    """Mean of a number; nothing where it is not defined."""
    if name not in found["numbers"]:
        return None
    value: float | None = found["numbers"][name]["mean"]
    return _NOT_MEASURED if value is None else value


def _lines(path: Path, window_s: float) -> dict[str, Series]:
    """Read the means of all scores over the windows; x is the middle of a window."""
    import polars as pl  # noqa: PLC0415

    found = {}
    table = pl.read_parquet(path).sort("metric", "window")
    for (metric,), part in table.group_by("metric", maintain_order=True):
        middle_s = (part["window"].to_numpy() + 0.5) * window_s
        found[str(metric)] = Series(str(metric), middle_s, part["value"].to_numpy())
    return found


def _chart(
    lines: Sequence[Series],
    truth: Series | None = None,
    *,
    title: str,
    x_label: str,
    y_label: str,
) -> Chart | None:
    if not lines:
        return None
    return line_chart(lines, truth, title=title, x_label=x_label, y_label=y_label)
