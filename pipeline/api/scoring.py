"""Scores of the rollouts of one scene: Waymo's metric, and the long-term protocols."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from infgen.clock import CLOCK
from infgen.config import ReferenceSettings, TokenSettings
from infgen.errors import ConfigError
from infgen.metrics.intervals import scene_mean
from infgen.metrics.long_term.protocols import PROTOCOLS
from infgen.metrics.long_term.reference import log_probabilities, no_counts
from infgen.metrics.long_term.table import Against, LogCounts
from infgen.metrics.wosac import metric as wosac
from infgen.metrics.wosac.logged import FUTURE_STEPS
from infgen.rollout.rollout import Rollout
from infgen.scene import Scene
from infgen.settings import build
from infgen.spatial.road_edges import scene_road_edges
from pipeline.engine.layout import Root
from pipeline.engine.manifest import read_manifest
from pipeline.stages.reference import measure_log
from pipeline.stages.reference_files import read_against, read_logged
from pipeline.stages.reference_tables import mean_log_counts
from pipeline.stages.score.stage import score_rollout
from pipeline.storage.scene_lookup import unit_folders

if TYPE_CHECKING:
    import polars as pl

LONG_TERM = tuple(protocol.name for protocol in PROTOCOLS)
METRICS = (*wosac.VERSIONS, *LONG_TERM)
"""All metrics by name."""


@dataclass(frozen=True)
class SceneScores(Mapping[str, float]):
    """Scores of one scene by name; ``scores["metametric"]`` is one of them.

    Attributes:
        scenario_id: Id of the log.
        metric: Name of the metric.
        numbers: All scores; NaN where there is nothing to score.
    """

    scenario_id: str
    metric: str
    numbers: Mapping[str, float]

    def __getitem__(self, name: str) -> float:
        """Return one score."""
        return self.numbers[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.numbers)

    def __len__(self) -> int:
        return len(self.numbers)

    def to_polars(self) -> "pl.DataFrame":
        """Return one row: scenario id, metric and a column per score."""
        import polars as pl  # noqa: PLC0415  # Takes 0.2 s.

        about = {"scenario_id": self.scenario_id, "metric": self.metric}
        return pl.DataFrame([{**about, **self.numbers}])


@dataclass(frozen=True)
class Reference:
    """The logs of a split, as the long-term protocols compare rollouts with them.

    Attributes:
        against: Histograms of all features, and numbers of agents.
        settings: Windows and radius.
        skipped: Why logs could not be measured, by scenario id.
    """

    against: Against
    settings: ReferenceSettings
    skipped: Mapping[str, str]


def open_reference(
    logs: str | Path | Iterable[Scene], *, window_s: float = 8.0, stride_s: float = 0.5
) -> Reference:
    """Get the logs that long-term scores compare rollouts with.

    Args:
        logs: The root of a run whose stage ``reference`` is made; or scenes, which are
            measured now, 0.1 to 1 s each.
        window_s: Length of a window; that of the stage for a root.
        stride_s: From one window to the next; that of the stage for a root.

    Raises:
        ConfigError: if the root has no reference, or no log can be measured.
    """
    if isinstance(logs, str | Path):
        return _of_root(Root(Path(logs).absolute()))
    settings = build(
        ReferenceSettings, {"window_s": window_s, "stride_s": stride_s}, "reference"
    )
    counts, numbers = no_counts(), {}
    skipped: dict[str, str] = {}
    for scene in logs:
        measured = measure_log(scene, TokenSettings(), settings)
        if isinstance(measured, str):
            skipped[scene.scenario_id] = measured
            continue
        counts += measured[0]
        binned = measured[1]
        numbers[scene.scenario_id] = LogCounts(binned.num_near, binned.num_all)
    if not numbers:
        raise ConfigError(f"no log can be measured: {next(iter(skipped.values()), 'none')}")
    near, everyone = mean_log_counts(numbers, settings)
    against = Against(
        log_p=log_probabilities(counts),
        split_near=near,
        split_all=everyone,
        logs=numbers,
        window_s=settings.window_s,
        stride_s=settings.stride_s,
    )
    return Reference(against, settings, skipped)


def score_rollouts(
    rollouts: Sequence[Rollout],
    scene: Scene,
    metric: str,
    reference: Reference | None = None,
    presence_radius_m: float = 0.0,
) -> SceneScores:
    """Score the rollouts of one scene: see ``infgen.score``.

    Raises:
        ConfigError: for a metric that does not exist, or that needs something else.
        ValueError: if the rollouts do not fit the log, or the log cannot be scored.
    """
    if metric in LONG_TERM:
        if reference is None:
            raise ConfigError(
                f"metric {metric!r} compares with the logs of a whole split; expected "
                "reference=infgen.open_reference(scenes), or of the root of a run"
            )
        return _long_term(rollouts, scene, metric, reference, presence_radius_m)
    if metric not in wosac.VERSIONS:
        near = get_close_matches(metric, METRICS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"there is {', '.join(METRICS)}"
        raise ConfigError(f"no metric {metric!r}; {hint}")
    if wosac.VERSIONS[metric].whole_log:
        raise ConfigError(
            f"{metric} scores scenes generated from their first step on; these rollouts go "
            "on from a log: name another metric, or use infgen.metrics.wosac"
        )
    try:
        given = wosac.from_rollouts(rollouts)
        scores = wosac.score(wosac.from_scene(scene), given, metric)
    except wosac.RolloutsError as error:
        seconds = FUTURE_STEPS * CLOCK.step_s
        raise wosac.RolloutsError(
            f"{error}; {metric} wants everyone of now for {seconds:g} s, as "
            "infgen.load(..., mode='wosac') simulates"
        ) from error
    return SceneScores(scene.scenario_id, metric, scores.numbers())


def _long_term(
    rollouts: Sequence[Rollout],
    scene: Scene,
    protocol: str,
    reference: Reference,
    radius_m: float,
) -> SceneScores:
    """Mean over the rollouts of what one protocol says, and of counts and rates."""
    edges, others = scene_road_edges(scene), tuple(f"{name}/" for name in LONG_TERM)
    against, settings = reference.against, reference.settings
    rows = [
        score_rollout(one, edges, against, settings, radius_m)[1].numbers
        for one in rollouts
    ]
    values = np.array([list(row.values()) for row in rows], dtype=np.float64)
    means = scene_mean(values, np.ones((1, len(rows))))[0]
    numbers = {
        name.removeprefix(f"{protocol}/"): float(mean)
        for name, mean in zip(rows[0], means, strict=True)
        if name.startswith(f"{protocol}/") or not name.startswith(others)
    }
    return SceneScores(scene.scenario_id, protocol, numbers)


def _of_root(root: Root) -> Reference:
    folder = root.latest_folder("reference")
    if folder is None:
        raise ConfigError(
            f"{root.path} holds no reference; `infgen reference --root {root.path}` "
            "makes it"
        )
    settings = read_manifest(folder)["settings"]["reference"]
    units = unit_folders(folder) or []
    logged = {name: log for unit in units for name, log in read_logged(unit).items()}
    measured = build(ReferenceSettings, settings, str(folder))
    return Reference(read_against(folder, logged, measured), measured, {})
