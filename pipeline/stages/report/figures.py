"""The figures of the report, from curves, scores and a rollout."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from infgen.clock import CLOCK
from infgen.views.charts.canvas import Chart
from infgen.views.charts.lines import Interval, Series, interval_chart, line_chart
from pipeline.engine.stage import FinishedUnit, Inputs
from pipeline.stages.report.tables import BUCKETS, FEATURES

if TYPE_CHECKING:
    from infgen.rollout.rollout import Rollout
    from infgen.scene import Scene

STRIP_EVERY_S = 6.0
MAX_VIEWS = 6

Curves = Mapping[str, Series]


class SimulatedScene(NamedTuple):
    """A rollout and the scene that it goes on from."""

    rollout: "Rollout"
    scene: "Scene"


def read_curves(path: Path, summary: Mapping[str, Any]) -> Curves:
    """Read the means of all metrics over the windows; x is the middle of a window."""
    import polars as pl  # noqa: PLC0415

    found = {}
    table = pl.read_parquet(path).sort("metric", "window")
    for (metric,), part in table.group_by("metric", maintain_order=True):
        middle_s = part["window"].to_numpy() * summary["stride_s"] + summary["window_s"] / 2
        found[str(metric)] = Series(str(metric), middle_s, part["value"].to_numpy())
    return found


def score_charts(summary: Mapping[str, Any], curves: Curves) -> list[Chart]:
    """Draw how scores and counts change along the rollouts, and each feature's score."""
    counts = summary["numbers"].get("agents/near", {})
    drawn = [
        _chart(
            {
                "ace/own_near": "own log, near",
                "ace/split_near": "split mean, near",
                "ace/truth_near": "later truth, near",
                "ace/own_all": "own log, all",
            },
            curves,
            "Agent count error (ACE) by window",
            "agents",
        ),
        _chart(
            {"agents/near": "rollouts, near", "agents/all": "rollouts, all"},
            curves,
            "Agents by window",
            "agents",
            _level("log mean, near", counts.get("log"), curves.get("agents/near")),
        ),
    ]
    for protocol in summary["protocols"]:
        names = {"composite": "composite", **BUCKETS}
        words = {f"{protocol}/{name}": label for name, label in names.items()}
        drawn.append(_chart(words, curves, f"Scores by window ({protocol})", "likelihood"))
        drawn.append(_features(protocol, summary["protocols"][protocol]["scores"]))
    return [chart for chart in drawn if chart is not None]


def first_simulated(inputs: Inputs) -> SimulatedScene | None:
    """Read the first rollout there is, and its scene."""
    from pipeline.storage.rollouts import read_rollouts  # noqa: PLC0415
    from pipeline.storage.scenes import read_scenes  # noqa: PLC0415

    logs = {done.name: done for done in inputs.units("ingest")}
    for done in inputs.units("rollout"):
        rollout = next(iter(read_rollouts(done.path)), None)
        log: FinishedUnit | None = logs.get(done.name.rsplit("-", 1)[0])
        if rollout is None or log is None:
            continue
        for scene in read_scenes(log.path):
            if scene.scenario_id == rollout.scenario_id:
                return SimulatedScene(rollout, scene)
    return None


def strips(played: SimulatedScene) -> list[str]:
    """Draw a log and a rollout of it every few seconds."""
    from infgen.views.scene.picture import rollout_strip, scene_strip  # noqa: PLC0415

    rollout, scene = played
    log_steps = _every(scene.now, scene.tracks.num_steps)
    steps = _every(rollout.now, rollout.num_steps)
    return [scene_strip(scene, log_steps), rollout_strip(rollout, scene.road_map, steps)]


def _every(now: int, num_steps: int) -> list[int]:
    """Steps every few seconds from now on, and the last."""
    stride = round(STRIP_EVERY_S / CLOCK.step_s)
    steps = list(range(now, num_steps, stride))[: MAX_VIEWS - 1]
    return sorted({*steps, num_steps - 1})


def _chart(
    words: Mapping[str, str],
    curves: Curves,
    title: str,
    y_label: str,
    truth: Series | None = None,
) -> Chart | None:
    series = [
        Series(label, curves[name].x, curves[name].y)
        for name, label in words.items()
        if name in curves
    ]
    if not series:
        return None
    x_label = "middle of the window, s after now"
    return line_chart(series, truth, title=title, x_label=x_label, y_label=y_label)


def _level(name: str, value: float | None, beside: Series | None) -> Series | None:
    """A level line as long as another."""
    if value is None or beside is None:
        return None
    return Series(name, beside.x, np.full(len(beside.x), value))


def _features(protocol: str, scores: Mapping[str, Any]) -> Chart:
    rows = [
        Interval(label, *(_nan(scores[name].get(field)) for field in _FIELDS))
        for name, label in FEATURES.items()
        if name in scores
    ]
    return interval_chart(
        rows,
        title=f"Score of each feature ({protocol})",
        x_label="likelihood",
        reference="the log's own",
    )


_FIELDS = ("mean", "low", "high", "log")


def _nan(value: float | None) -> float:
    return float("nan") if value is None else value


def find_lowest(path: Path, count: int) -> Sequence[tuple[str, int, float]]:
    """Read the rollouts with the lowest composite."""
    import polars as pl  # noqa: PLC0415

    table = (
        pl.scan_parquet(path)
        .filter(
            (pl.col("metric") == "corrected/composite") & pl.col("rollout").is_not_null()
        )
        .sort("value", "scenario_id", "rollout")
        .head(count)
        .select("scenario_id", "rollout", "value")
        .collect()
    )
    return [(str(s), int(r), float(v)) for s, r, v in table.iter_rows()]
