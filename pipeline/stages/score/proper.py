"""Protocol ``proper`` in stage ``score``: from rollouts to parts of scenes, and on disk."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from infgen.config import ReferenceSettings
from infgen.metrics.long_term.binned import Binned, bin_traffic
from infgen.metrics.long_term.protocols import FEATURES
from infgen.metrics.proper.context import read_context
from infgen.metrics.proper.engineering.measure import read_place
from infgen.metrics.proper.quantities import SCORES
from infgen.metrics.proper.retrieval import CLIMATOLOGY_LOGS, LogCourse, retrieve
from infgen.metrics.proper.sample import Frame, Sample, take_sample
from infgen.metrics.proper.scene import (
    CLIMATOLOGY,
    CONTEXT,
    LOG_LIKELIHOOD,
    MODEL,
    PERSISTENCE,
    References,
    SceneScores,
    score_scene,
)
from infgen.metrics.traffic import Traffic, logged_rows, observe_log
from infgen.metrics.windows import cut_windows
from infgen.rollout.rollout import Rollout
from infgen.scene import Scene
from infgen.spatial.road_edges import RoadEdges
from pipeline.stages.score.summary import add_sums
from pipeline.stages.score.write import write_sums

PARTS, SUMS = "proper.parquet", "proper_sums.parquet"
CURVES = "proper_curves.parquet"
PARTS_SCHEMA: dict[str, Any] = {
    "scenario_id": pl.String,
    "part": pl.String,
    "values": pl.List(pl.Float32),
}
SCENE_CURVES_SCHEMA = {
    "metric": pl.String,
    "window": pl.Int32,
    "value": pl.Float64,
    "scenes": pl.Int64,
}
PROPER = "proper"
"""Before the names of its numbers in tables."""


class SceneEnsemble:
    """The rollouts of one scene, kept one by one, and then scored together."""

    def __init__(
        self,
        scene: Scene,
        edges: RoadEdges | None,
        rollouts: Sequence[Rollout],
        settings: ReferenceSettings,
        *,
        logged_lights: bool,
    ) -> None:
        """Look at a scene's log, as long as all of its rollouts.

        Args:
            scene: The log.
            edges: Its road edges.
            rollouts: Of which only the lengths are read.
            settings: How rollouts and logs are measured.
            logged_lights: Whether the lights of the rollouts are those of the log.
        """
        self._scene, self._log = scene, observe_log(scene)
        window_s, radius_m = settings.proper_window_s, settings.count_radius_m
        logged = scene.tracks.num_steps - scene.now - 1
        steps = min([logged, *(one.num_steps - one.now - 1 for one in rollouts)])
        self._frame = Frame(
            windows=cut_windows(steps, window_s, window_s),
            window_s=window_s,
            radius_m=radius_m,
            place=read_place(scene, radius_m, logged_lights=logged_lights),
        )
        self._edges = edges
        self._samples: list[Sample] = []

    def add(self, traffic: Traffic, binned: Binned, rollout: Rollout) -> None:
        """Keep what is scored of one rollout."""
        if self._frame.windows.count:
            self._samples.append(
                take_sample(traffic, binned, rollout.id, self._frame, logged=False)
            )

    def score(self, logs: Sequence[LogCourse]) -> SceneScores | None:
        """Score the rollouts against the log and a split's; None if no window holds both.

        Args:
            logs: The sample of the split.
        """
        if not self._samples:
            return None
        scenario_id, radius_m = self._scene.scenario_id, self._frame.radius_m
        binned = bin_traffic(self._log, self._edges, radius_m, as_logged=True)
        ids = self._scene.tracks.id[logged_rows(self._scene)]
        log = take_sample(self._log, binned, ids, self._frame, logged=True)
        context = read_context(self._scene, self._log, radius_m)
        references = References(
            climatology=[
                one for one in logs[:CLIMATOLOGY_LOGS] if one.scenario_id != scenario_id
            ],
            neighbours=retrieve(scenario_id, context, logs),
        )
        return score_scene(log, self._samples, references)


@dataclass(slots=True)
class ProperTally:
    """Parts of scenes, and sums over scenes in each window.

    Attributes:
        parts: Parts of each scene, by scenario id.
        sums: Sum of each curve and number of scenes with a value [value or count, window].
    """

    parts: dict[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    sums: dict[str, np.ndarray] = field(default_factory=dict)

    def add(self, scenario_id: str, scores: SceneScores) -> None:
        """Take one scene."""
        self.parts[scenario_id] = scores.parts
        for name, values in scores.curves.items():
            known = ~np.isnan(values)
            sums = np.stack([np.where(known, values, 0.0), known.astype(np.float64)])
            self.sums[name] = add_sums(self.sums.get(name, sums[:, :0]), sums)


def proper_numbers(parts: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Numbers of one scene whose mean over scenes means something, from its parts."""
    found = {f"{PROPER}/{n}": v for n, v in zip(SCORES, parts[MODEL], strict=True)}
    for part in (PERSISTENCE, CLIMATOLOGY, CONTEXT):
        values = zip(SCORES, parts[part], strict=True)
        found |= {f"{PROPER}/{part}/{name}": value for name, value in values}
    for feature, value in zip(FEATURES, parts[LOG_LIKELIHOOD], strict=True):
        found[f"{PROPER}/{LOG_LIKELIHOOD}/{feature.name}"] = value
    return {name: float(value) for name, value in found.items()}


def write_proper(folder: Path, tally: ProperTally) -> None:
    """Write what one unit has tallied."""
    rows = [
        (scenario_id, name, values.tolist())
        for scenario_id, parts in tally.parts.items()
        for name, values in parts.items()
    ]
    pl.DataFrame(rows, schema=PARTS_SCHEMA, orient="row").write_parquet(folder / PARTS)
    write_sums(folder / SUMS, tally.sums)


def read_parts(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Read the parts of each scene of a unit."""
    table = pl.read_parquet(path / PARTS)
    values = table["values"].explode().drop_nulls().to_numpy()
    ends = np.cumsum(table["values"].list.len().to_numpy())
    found: dict[str, dict[str, np.ndarray]] = {}
    parts = np.split(values, ends[:-1]) if len(ends) else []
    names = zip(table["scenario_id"].to_list(), table["part"].to_list(), strict=True)
    for (scenario_id, name), part in zip(names, parts, strict=True):
        found.setdefault(scenario_id, {})[name] = part.astype(np.float64)
    return found


def write_proper_curves(target: Path, found: Mapping[str, np.ndarray]) -> None:
    """Write the mean over scenes of every score in every window."""
    rows = [
        (metric, window, float(total / count), int(count))
        for metric, values in found.items()
        for window, (total, count) in enumerate(values.T)
        if count
    ]
    pl.DataFrame(rows, schema=SCENE_CURVES_SCHEMA, orient="row").write_parquet(target)
