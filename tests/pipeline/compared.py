"""Scores made by hand, of runs that never were."""

import numpy as np

from infgen.config import ReferenceSettings, ScoreSettings
from infgen.views.sheets import Measured
from pipeline.comparison.execution import ExecutedRun
from pipeline.comparison.result import ComparisonResult
from pipeline.comparison.runs import ArmRun
from pipeline.comparison.scores import Scored
from pipeline.settings.overlay import Overlay
from pipeline.settings.presets import Arm, Preset
from pipeline.stages.score.summary import Tally

NOTHING = Overlay((), {})


def arm(name, **changes) -> Arm:
    """An arm that sets nothing."""
    given = {
        "label": name,
        "profile": (),
        "settings": NOTHING,
        "rollout_sets": {"long": NOTHING, "motion-only": NOTHING, "wosac": NOTHING},
        "starts_from": None,
        "ablates": None,
        "rules_of": None,
        "published": None,
        "where": "stages.yaml:1",
    }
    return Arm(name=name, **{**given, **changes})


def scored(
    method,
    seed,
    means,
    *,
    mode="long",
    numbers=None,
    curves=None,
    rules="none",
    biased=False,
) -> Scored:
    """A scored run: means of each scene by name, numbers, and curves over the windows."""
    method = arm(method) if isinstance(method, str) else method
    sums = {
        name: np.stack([np.asarray(values, float), np.ones(len(values))])
        for name, values in (curves or {}).items()
    }
    return Scored(
        ran=ExecutedRun(ArmRun("mini", method, seed, mode), "made"),
        mode=mode,
        weights=f"weights of {method.name} {seed}",
        scenes=len(means),
        rollouts=len(means),
        official=1,
        metric="wosac-2025",
        rules=rules,
        biased=biased,
        numbers={
            name: Measured(*_spread(value)) for name, value in (numbers or {}).items()
        },
        tally=Tally(means=dict(means), rollouts=len(means), sums=sums),
        settings=ScoreSettings(bootstrap_resamples=200),
        measures=ReferenceSettings(),
    )


def compared(runs, logs=None, *, missing=(), count_error="truth") -> ComparisonResult:
    """A comparison of scored runs; ``missing`` are runs that failed."""
    arms = {one.ran.arm_run.arm.name: one.ran.arm_run.arm for one in runs}
    arms |= {each.arm_run.arm.name: each.arm_run.arm for each in missing}
    preset = Preset("mini", (), 1, count_error, {}, arms)
    ran = [*[one.ran for one in runs], *missing]
    return ComparisonResult(preset, ran, list(runs), logs or Tally())


def _spread(value):
    return value if isinstance(value, tuple) else (value,)
