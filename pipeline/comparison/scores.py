"""Scores that runs of a comparison left on disk, and those of the logs they continue."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from infgen.config import ReferenceSettings, RolloutSettings, ScoreSettings
from infgen.metrics.long_term.table import make_row
from infgen.views.sheets import Measured
from pipeline.comparison.execution import ExecutedRun
from pipeline.comparison.runs import ROLLOUT, SCORE, TRAIN
from pipeline.engine.inputs import FinishedInputs, finished_units
from pipeline.engine.layout import read_json
from pipeline.engine.manifest import read_manifest
from pipeline.engine.plan import Plan
from pipeline.stages.reference_files import read_against, read_binned, read_logged
from pipeline.stages.score.gathered import read_means, read_sums
from pipeline.stages.score.proper import PROPER, proper_numbers, read_parts
from pipeline.stages.score.summary import Tally
from pipeline.stages.score.tables import ROLLOUTS, WOSAC
from pipeline.stages.score.write import SUMS

REFERENCE = "reference"
OFFICIAL = "wosac"
BIASES = ("add_bias", "remove_bias")
"""Figures of a stage ``rollout``: what was added to the odds of insertions and removals."""


@dataclass(frozen=True, slots=True)
class Scored:
    """One scored run.

    Attributes:
        ran: The run.
        mode: Kind of rollouts: ``long``, ``motion-only`` or ``wosac``.
        weights: Fingerprint of the weights that were simulated.
        scenes: Scenes that were scored.
        rollouts: Rollouts that were scored.
        official: Scenes that the official metric could score.
        metric: Its version.
        rules: Rules over the network's choices, in words; ``none`` without any.
        biased: Whether biases were added to the odds of insertions or removals.
        numbers: Every number with its interval over scenes, by name.
        tally: Means of each scene and curves over the windows.
        settings: How rollouts were scored.
        measures: How rollouts and logs were measured.
    """

    ran: ExecutedRun
    mode: str
    weights: str
    scenes: int
    rollouts: int
    official: int
    metric: str
    rules: str
    biased: bool
    numbers: Mapping[str, Measured]
    tally: Tally
    settings: ScoreSettings
    measures: ReferenceSettings

    @property
    def arm(self) -> str:
        """Name of its arm."""
        return self.ran.arm_run.arm.name

    @property
    def seed(self) -> int:
        """Its seed."""
        return self.ran.arm_run.seed

    @property
    def rollout_set(self) -> str:
        """Name of its rollout set."""
        return self.ran.arm_run.rollout_set

    def to_json(self) -> dict[str, Any]:
        """Where its numbers come from, and what they are."""
        return {
            **self.ran.to_json(),
            "mode": self.mode,
            "weights": self.weights,
            "scenes": self.scenes,
            "rollouts": self.rollouts,
            "official_scenes": self.official,
            "rules": self.rules,
            "biased": self.biased,
            "settings": list(self.ran.arm_run.settings.words),
            "numbers": {name: one.to_json() for name, one in self.numbers.items()},
        }


def read_scored(ran: ExecutedRun) -> Scored:
    """Read the scores of a run that is whole.

    Raises:
        StoreError: if they are damaged.
    """
    plan = _plan(ran)
    summary = read_json(plan.root.folder(SCORE, plan[SCORE].key) / "summary.json")
    rollout: RolloutSettings = plan[ROLLOUT].settings
    weights = read_manifest(plan.root.folder(TRAIN, plan[TRAIN].key))["report"]["weights"]
    simulated = read_manifest(plan.root.folder(ROLLOUT, plan[ROLLOUT].key))["report"]
    settings = plan[SCORE].settings
    return Scored(
        ran=ran,
        mode=rollout.mode,
        weights=str(weights),
        scenes=summary["scenes"],
        rollouts=summary["rollouts"],
        official=summary[OFFICIAL]["scenes"],
        metric=summary[OFFICIAL]["version"],
        rules=rollout.rules_in_words,
        biased=any(simulated.get(name, 0.0) != 0 for name in BIASES),
        numbers=dict(_numbers(summary)),
        tally=_tally(plan),
        settings=settings["score"],
        measures=settings["reference"],
    )


def read_logs(ran: ExecutedRun, scenario_ids: Sequence[str]) -> Tally:
    """Score the logs of some scenes as if they were rollouts.

    The reference of a split knows all its logs; beside rollouts of some scenes stand the
    logs of the same scenes.
    """
    plan, wanted = _plan(ran), set(scenario_ids)
    inputs = FinishedInputs(plan.root, plan[SCORE])
    settings: ReferenceSettings = plan[SCORE].settings["reference"]
    folder, tally = inputs.folder(REFERENCE), Tally()
    for unit in inputs.units(REFERENCE):
        logged = read_logged(unit.path)
        if not wanted & logged.keys():
            continue
        against = read_against(folder, logged, settings)
        for binned in read_binned(unit.path):
            if binned.scenario_id in wanted:
                tally.add(binned.scenario_id, make_row(binned, against))
        tally.close_unit()
    return tally


def middle_s(measures: ReferenceSettings, count: int) -> np.ndarray:
    """Middle of each window in seconds after now."""
    return np.arange(count) * measures.stride_s + measures.window_s / 2


def _plan(ran: ExecutedRun) -> Plan:
    if ran.plan is None:
        raise ValueError(f"{ran.arm_run.words} was never planned")
    return ran.plan


def _tally(plan: Plan) -> Tally:
    """Gather what the units of a stage ``score`` tallied, by every protocol."""
    manifest = read_manifest(plan.root.folder(SCORE, plan[SCORE].key))
    units = [
        done
        for done in finished_units(plan.root, SCORE, manifest)
        if ROLLOUTS in done.report
    ]
    folders = [done.path for done in units]
    found = read_means(folders)
    rows = zip(found.scenario_ids, found.values.tolist(), strict=True)
    means = {scene: dict(zip(found.names, row, strict=True)) for scene, row in rows}
    for folder in folders:
        for one in read_json(folder / WOSAC):
            scores = one.get("scores", {})
            official = {f"{OFFICIAL}/{name}": _or_nan(v) for name, v in scores.items()}
            means[one["scenario_id"]].update(official)
        for scenario_id, parts in read_parts(folder).items():
            means[scenario_id].update(proper_numbers(parts))
    return Tally(
        means=means,
        rollouts=sum(done.report[ROLLOUTS] for done in units),
        sums=read_sums(folders, SUMS),
    )


def _numbers(summary: Mapping[str, Any]) -> Iterator[tuple[str, Measured]]:
    """Every number of a summary by one name."""
    for protocol, part in summary["protocols"].items():
        for name, entry in part["scores"].items():
            yield f"{protocol}/{name}", _measured(entry)
        for name, value in part["divergence"].items():
            yield f"{protocol}/divergence/{name}", Measured(value)
    for name, entry in summary["numbers"].items():
        yield name, _measured(entry)
    for name, entry in summary[PROPER]["numbers"].items():
        yield f"{PROPER}/{name}", _measured(entry)
    for name, entry in summary[OFFICIAL]["scores"].items():
        yield f"{OFFICIAL}/{name}", _measured(entry)


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _measured(entry: Mapping[str, float | None]) -> Measured:
    return Measured(entry["mean"], entry["low"], entry["high"])
