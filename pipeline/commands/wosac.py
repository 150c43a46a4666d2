"""Official scores of submissions and of our own rollouts, against raw or ingested logs."""

import math
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from infgen.errors import ConfigError
from infgen.metrics.wosac import metric as wosac
from infgen.metrics.wosac.rollouts import Rollouts
from infgen.metrics.wosac.submission import NUM_ROLLOUTS, Refused, read_submission
from infgen.metrics.wosac.versions import VERSIONS
from pipeline.engine import signals
from pipeline.engine.atomic import StoreError
from pipeline.engine.events import Event
from pipeline.storage.scene_lookup import SceneLookup, open_scene_lookup, unit_folders

SUBMISSION_FILES = "*binproto*"


class Future(NamedTuple):
    """Rollouts of one scene, or why there are none.

    Attributes:
        share: How much of all rollouts is read with it, 0 to 1.
        found: The rollouts.
    """

    share: float
    found: Rollouts | Refused


@dataclass(frozen=True, slots=True)
class Official:
    """Scores of all scenes under one version of the metric.

    Attributes:
        metric: Name of the version.
        scores: By scenario id, in the order of the rollouts.
        refused: What could not be scored.
    """

    metric: str
    scores: Mapping[str, wosac.Scores]
    refused: Sequence[Refused]

    def mean(self) -> dict[str, float]:
        """Mean of every score over the scenes; empty without any."""
        if not self.scores:
            return {}
        return wosac.mean_scores(list(self.scores.values())).numbers()

    def to_json(self) -> dict[str, Any]:
        """Everything under the official names; a number without a value is null."""
        return {
            "metric": self.metric,
            "scenarios": {k: _plain(one.numbers()) for k, one in self.scores.items()},
            "mean": _plain(self.mean()),
            "refused": [one._asdict() for one in self.refused],
        }


def score_files(
    records: Sequence[str],
    rollouts: Path,
    metric: str,
    num_rollouts: int = NUM_ROLLOUTS,
    tell: Callable[[Event], None] = lambda _: None,
) -> Official:
    """Score the rollouts of one file or folder, a scene in memory at a time.

    Args:
        records: Raw records (paths, patterns, folders, URLs), or one ingested folder.
        rollouts: A submission, a folder of its files, or a folder of our rollouts.
        metric: A name in ``VERSIONS``.
        num_rollouts: How many rollouts each scene of a submission must have; 0 for any.
        tell: Receives progress events.

    Raises:
        ConfigError: for another metric, or where there is nothing to score.
        StoreError: if a store is damaged.
    """
    if metric not in VERSIONS:
        near = get_close_matches(metric, VERSIONS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(VERSIONS)}"
        raise ConfigError(f"no metric {metric!r}; {hint}")
    if VERSIONS[metric].whole_log and unit_folders(rollouts) is not None:
        raise ConfigError(
            f"{metric} scores scenes generated from their first step on; our rollouts "
            "go on from a log: name another metric"
        )
    try:
        logs = open_scene_lookup(records)
        official = score_futures(logs, read_futures(rollouts, num_rollouts), metric, tell)
    except OSError as error:
        raise ConfigError(str(error)) from error
    if not official.scores and not official.refused:
        raise ConfigError(f"{rollouts} holds no rollouts")
    return official


def score_futures(
    logs: SceneLookup, futures: Iterator[Future], metric: str, tell: Callable[[Event], None]
) -> Official:
    """Score scene after scene; a wrong one is refused with the reason."""
    scores: dict[str, wosac.Scores] = {}
    refused: list[Refused] = []
    about = {"event": "progress", "stage": "wosac"}
    tell({**about, "event": "work-started", "units": 1, "made": 0, "what": "scenes"})
    tell({**about, "done": 0, "total": 1, "note": ""})
    for done, (share, future) in enumerate(futures, start=1):
        signals.raise_if_stopped()
        found = _score(logs, future, metric, scores)
        if isinstance(found, Refused):
            refused.append(found)
        else:
            scores[found.scenario_id] = found
        note = f"{len(refused)} refused" if refused else ""
        total = max(done, round(done / share)) if share else done
        tell({**about, "done": done, "total": total, "note": note})
    return Official(metric, scores, refused)


def _score(
    logs: SceneLookup, rollouts: Rollouts | Refused, metric: str, known: Container[str]
) -> wosac.Scores | Refused:
    """Score one scene, or say why it cannot be."""
    if isinstance(rollouts, Refused):
        return rollouts
    if rollouts.scenario_id in known:
        return Refused(rollouts.scenario_id, "its rollouts are given twice")
    try:
        log = wosac.from_scene(logs.find(rollouts.scenario_id))
        return wosac.score(log, rollouts, metric)
    except (ConfigError, StoreError):
        raise
    except ValueError as error:
        reason = str(error).removeprefix(f"scene {rollouts.scenario_id}: ")
        return Refused(rollouts.scenario_id, reason)


def read_futures(path: Path, num_rollouts: int) -> Iterator[Future]:
    """Stream the rollouts of a submission, of a folder of its files, or of our store.

    Raises:
        ConfigError: if there is no such file, or the folder holds neither.
        OSError: if it cannot be read.
    """
    units = unit_folders(path)
    if units is not None:
        yield from _read_store(units)
        return
    files = sorted(path.glob(SUBMISSION_FILES)) if path.is_dir() else [path]
    if not files or not path.exists():
        what = f"files {SUBMISSION_FILES} or stage of rollouts" if path.exists() else "file"
        raise ConfigError(f"{path}: no such {what}")
    for at, file in enumerate(files):
        for share, found in _read_file(file, num_rollouts):
            yield Future((at + share) / len(files), found)


def _read_file(path: Path, num_rollouts: int) -> Iterator[Future]:
    size, read = max(1, path.stat().st_size), [0]
    for found in read_submission(path, num_rollouts, read.append):
        yield Future(min(1.0, read.pop() / size), found)


def _read_store(units: Sequence[Path]) -> Iterator[Future]:
    """Gather our rollouts scene by scene; all of a scene's are in one unit."""
    import polars as pl  # noqa: PLC0415

    from pipeline.storage.rollouts import read_rollouts  # noqa: PLC0415

    indices = [pl.read_parquet(unit / "index.parquet")["scenario_id"] for unit in units]
    total, done = sum(ids.n_unique() for ids in indices), 0
    for unit in units:
        for scenario_id, group in groupby(read_rollouts(unit), lambda r: r.scenario_id):
            done += 1
            found: Rollouts | Refused
            try:
                found = wosac.from_rollouts(list(group))
            except ValueError as error:
                reason = str(error).removeprefix(f"scene {scenario_id}: ")
                found = Refused(scenario_id, reason)
            yield Future(done / total, found)


def _plain(numbers: Mapping[str, float]) -> dict[str, float | None]:
    """JSON knows no NaN."""
    return {k: None if math.isnan(value) else value for k, value in numbers.items()}
