"""What a split's scores add up to: means over scenes with their intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from infgen.config import ReferenceSettings, ScoreSettings
from infgen.metrics.intervals import Bootstrap, Interval, scene_mean
from infgen.metrics.long_term.protocols import FEATURES, PROTOCOLS
from infgen.metrics.long_term.table import COMPOSITE, Row, named

MAX_NAMED = 20
"""Scenes named for each reason; the rest is counted."""


@dataclass(frozen=True, slots=True)
class Gathered:
    """What the stage reports.

    Attributes:
        scenes: Scenes with scored rollouts.
        rollouts: Scored rollouts.
        logs: Logs behind the reference.
        missing: Scenes that have rollouts but no log.
        composite_paper: Mean over scenes.
        composite_corrected: Mean over scenes.
        mean_ace: Against the scenes' own logs, within the count radius.
        wosac_metametric: Mean over the scenes that could be scored; None without any.
    """

    scenes: int
    rollouts: int
    logs: int
    missing: list[str]
    composite_paper: float | None
    composite_corrected: float | None
    mean_ace: float | None
    wosac_metametric: float | None


class Curve(NamedTuple):
    """Mean of a metric in each window, and how many rollouts have a value there."""

    value: np.ndarray
    rollouts: np.ndarray


@dataclass(slots=True)
class Tally:
    """Means per scene and sums per window, filled rollout by rollout.

    Attributes:
        means: Mean over a scene's rollouts of each metric, by scenario id.
        rollouts: Rollouts seen.
        sums: Sum of each metric that has a value in every window, and how many rollouts
            have one, [value or count, window].
    """

    means: dict[str, dict[str, float]] = field(default_factory=dict)
    rollouts: int = 0
    sums: dict[str, np.ndarray] = field(default_factory=dict)
    _open: dict[str, list[Mapping[str, float]]] = field(default_factory=dict)

    def add(self, scenario_id: str, row: Row) -> None:
        """Take one rollout."""
        self.rollouts += 1
        self._open.setdefault(scenario_id, []).append(row.numbers)
        for name, values in row.curves.items():
            known = ~np.isnan(values)
            add = np.stack([np.where(known, values, 0.0), known.astype(np.float64)])
            self.sums[name] = add_sums(self.sums.get(name, add[:, :0]), add)

    def close_unit(self) -> None:
        """Average the rollouts of each scene; all of a scene's rollouts are in one unit."""
        for scenario_id, rows in self._open.items():
            values = np.array([list(row.values()) for row in rows])
            mean = scene_mean(values, np.ones((1, len(rows))))[0]
            self.means[scenario_id] = dict(zip(rows[0], mean.tolist(), strict=True))
        self._open.clear()

    def curves(self) -> dict[str, Curve]:
        """Mean curves."""
        return mean_curves(self.sums)


def mean_curves(sums: Mapping[str, np.ndarray]) -> dict[str, Curve]:
    """Mean curves; buckets and composites follow from the features' curves.

    Args:
        sums: Sums and counts [value or count, window] by metric.
    """
    found = {}
    for name, (total, count) in sums.items():
        mean = np.where(count > 0, total / np.where(count > 0, count, 1), np.nan)
        found[name] = Curve(mean, count)
    for protocol in PROTOCOLS if found else ():
        names = [f"{protocol.name}/{feature.name}" for feature in FEATURES]
        features = np.stack([found[name].value for name in names], axis=-1)
        rollouts = found[f"{protocol.name}/num_entries"].rollouts
        for label, value in named(features):
            name = f"{protocol.name}/{label}"
            if name not in names:
                found[name] = Curve(value, ~np.isnan(value) * rollouts)
    return found


class Means(NamedTuple):
    """Means of scenes.

    Attributes:
        scenario_ids: Of the scenes.
        names: Of the metrics.
        values: Mean over a scene's rollouts [scene, metric]; NaN where it has no value.
    """

    scenario_ids: list[str]
    names: list[str]
    values: np.ndarray

    def matrix(self, names: Sequence[str]) -> np.ndarray:
        """Means of some metrics [scene, metric]; one scene without any if there is none."""
        if not self.scenario_ids:
            return np.full((1, len(names)), np.nan)
        return self.values[:, [self.names.index(name) for name in names]]


@dataclass(frozen=True, slots=True)
class Summary:
    """All a split's scores on their way to ``summary.json``.

    Attributes:
        settings: Of the stage.
        reference: How logs and rollouts were measured.
        draws: How scenes are drawn again.
        means: Of the rollouts.
        rollouts: How many there are.
        log_means: Of the logs, scored as if they were rollouts.
        divergence: Jensen-Shannon, [protocol, feature].
        wosac: Official scores, or why there are none, by scenario id.
    """

    settings: ScoreSettings
    reference: ReferenceSettings
    draws: Bootstrap
    means: Means
    rollouts: int
    log_means: Means
    divergence: np.ndarray
    wosac: Mapping[str, Mapping[str, Any]]

    def build(self, missing: Sequence[str], skipped: Sequence[str]) -> dict[str, Any]:
        """Everything, JSON-able; a number without a value is null."""
        every = self.means.names
        names = [name for name in every if name.split("/")[0] not in _PROTOCOL_NAMES]
        names += [name for name in every if name.endswith("_rate")]
        return {
            "scenes": len(self.means.scenario_ids),
            "rollouts": self.rollouts,
            "logs": len(self.log_means.scenario_ids),
            "missing_scenes": _some(missing),
            "skipped_logs": _some(skipped),
            "window_s": self.reference.window_s,
            "stride_s": self.reference.stride_s,
            "count_radius_m": self.reference.count_radius_m,
            "protocols": {
                protocol.name: self._protocol(at) for at, protocol in enumerate(PROTOCOLS)
            },
            "numbers": self._numbers(names),
            "wosac": self._official(),
        }

    def _protocol(self, at: int) -> dict[str, Any]:
        """Scores with intervals and the log's own, and each feature's divergence."""
        protocol = PROTOCOLS[at].name
        names = [f"{protocol}/{feature.name}" for feature in FEATURES]
        played, logged = self._intervals(names, _follow)
        labels = [name for name, _ in named(np.zeros((1, len(FEATURES))))]
        divergence = dict(
            zip([f.name for f in FEATURES], map(_number, self.divergence[at]), strict=True)
        )
        return {"scores": _entries(labels, played, logged), "divergence": divergence}

    def _numbers(self, names: Sequence[str]) -> dict[str, Any]:
        played, logged = self._intervals(names, _same)
        return _entries(names, played, logged)

    def _official(self) -> dict[str, Any]:
        scored = [entry["scores"] for entry in self.wosac.values() if "scores" in entry]
        reasons = {k: v["skipped"] for k, v in self.wosac.items() if "skipped" in v}
        skipped = [text if k in text else f"{k}: {text}" for k, text in reasons.items()]
        names = list(scored[0]) if scored else []
        values = np.array([[s[name] for name in names] for s in scored], dtype=np.float64)
        values = values.reshape(len(scored), len(names))
        interval = self.draws.interval(values, _same)
        return {
            "version": self.settings.wosac_version,
            "scenes": len(scored),
            "skipped": _some(skipped),
            "not_measured": {
                name: count
                for name, count in zip(
                    names, np.isnan(values).sum(axis=0).tolist(), strict=True
                )
                if count
            },
            "scores": _entries(names, interval, None),
        }

    def _intervals(self, names: Sequence[str], follow: Any) -> tuple[Interval, Interval]:
        """Intervals of what follows from some metrics: of the rollouts and of the logs."""
        played, logged = (
            self.draws.interval(means.matrix(names), follow)
            for means in (self.means, self.log_means)
        )
        return played, logged


def figures(summary: Mapping[str, Any], missing: Sequence[str]) -> Gathered:
    """The few figures that the engine shows."""
    metametric = summary["wosac"]["scores"].get("metametric", {}).get("mean")
    ace = summary["numbers"].get("ace/own_near", {}).get("mean")
    composite = {
        name: protocol["scores"][COMPOSITE]["mean"]
        for name, protocol in summary["protocols"].items()
    }
    return Gathered(
        scenes=summary["scenes"],
        rollouts=summary["rollouts"],
        logs=summary["logs"],
        missing=list(missing),
        composite_paper=composite["paper"],
        composite_corrected=composite["corrected"],
        mean_ace=ace,
        wosac_metametric=metametric,
    )


_PROTOCOL_NAMES = tuple(protocol.name for protocol in PROTOCOLS)


def _follow(means: np.ndarray) -> np.ndarray:
    """Composites, buckets and features [resample, number] from feature means."""
    return np.stack([value for _, value in named(means)], axis=-1)


def _same(means: np.ndarray) -> np.ndarray:
    return means


def _entries(
    names: Sequence[str], played: Interval, logged: Interval | None
) -> dict[str, dict[str, float | None]]:
    """One entry per number: mean and interval, and the log's own mean."""
    entries = {}
    for at, name in enumerate(names):
        entries[name] = {
            "mean": _number(played.mean[at]),
            "low": _number(played.low[at]),
            "high": _number(played.high[at]),
        }
        if logged is not None:
            entries[name]["log"] = _number(logged.mean[at])
    return entries


def _some(lines: Sequence[str]) -> dict[str, Any]:
    """Count lines and name the first."""
    return {"count": len(lines), "first": list(lines[:MAX_NAMED])}


def _number(value: float) -> float | None:
    """JSON knows no NaN."""
    return None if np.isnan(value) else float(value)


def add_sums(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Add sums [value or count, window]; beyond the end of the shorter there is nothing."""
    longer, shorter = (one, other) if one.shape[1] >= other.shape[1] else (other, one)
    total = longer.copy()
    total[:, : shorter.shape[1]] += shorter
    return total
