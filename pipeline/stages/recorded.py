"""Recorded drives as rollouts of stage ``rollout`` (``rollout.recordings``)."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from infgen.config import RolloutSettings
from pipeline.engine.plan import PlanError
from pipeline.engine.stage import Inputs, Progress, Report, Source, Unit
from pipeline.storage.recordings import DRIVE, find_recordings, fingerprint, read_about
from pipeline.storage.rollouts import read_rollouts, write_rollouts

if TYPE_CHECKING:
    from infgen.rollout.rollout import Rollout

MAX_NAMED = 5
UNKNOWN = "unknown"
"""Rules of recordings that were saved before they were named."""


def find_recorded(root: Path, settings: RolloutSettings) -> list[Source]:
    """Find the recordings that the settings name, with their identities.

    Raises:
        ConfigError: if there are none where they are said to be.
    """
    if not settings.recordings:
        return []
    folder = Path(settings.recordings).absolute()
    found = find_recordings(folder, "rollout.recordings")
    return [Source(str(path), path.name, fingerprint(path)) for path in found]


def plan_recorded(inputs: Inputs) -> list[Unit]:
    """Make a unit of all drives through scenes of one file of records.

    Raises:
        PlanError: if a recording is of another file.
    """
    names = [done.name for done in inputs.units("ingest")]
    by_file: dict[str, list[Source]] = defaultdict(list)
    for recording in inputs.sources:
        source = str(read_about(Path(recording.url))[DRIVE]["source"])
        if source not in names:
            raise PlanError(
                f"recording {recording.url} is of {source}, expected one of "
                f"{', '.join(names[:MAX_NAMED])}; name the records that were driven"
            )
        by_file[source].append(recording)
    return [
        Unit(
            name=f"{source}-00000",
            inputs={one.name: one.fingerprint for one in recordings},
            task={"recordings": [one.url for one in recordings]},
        )
        for source, recordings in sorted(by_file.items())
    ]


def collect_recorded(unit: Unit, target: Path, progress: Progress) -> Report:
    """Copy recordings into a unit of rollouts, those of a scene together and numbered."""
    folders = [Path(path) for path in unit.task["recordings"]]
    abouts = [read_about(folder) for folder in folders]
    rollouts = _numbered([one for folder in folders for one in read_rollouts(folder)])
    rows = write_rollouts(target, unit.name, ([rollout] for rollout in rollouts))
    progress(len(rows), len(rollouts), "recordings")
    totals = {
        name: sum(row[name] for row in rows) for name in ("agents", "inserted", "left")
    }
    played = abouts[0]["settings"]["rollout"]
    return {
        "rollouts": len(rows),
        **totals,
        "refused": [],
        "add_bias": played["add_bias"],
        "remove_bias": played["remove_bias"],
        "device": played["device"],
        "rules": abouts[0][DRIVE].get("rules", UNKNOWN),
        "simulates": f"{abouts[0][DRIVE]['simulates']}; recorded drives",
    }


def _numbered(rollouts: Sequence["Rollout"]) -> "list[Rollout]":
    """Sort by scene, and number those of a scene from 0 on."""
    seen: Counter[str] = Counter()
    found = []
    for rollout in sorted(rollouts, key=lambda one: one.scenario_id):
        found.append(replace(rollout, index=seen[rollout.scenario_id]))
        seen[rollout.scenario_id] += 1
    return found
