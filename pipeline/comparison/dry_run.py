"""What the runs of a comparison would still make. Looks only; writes nothing."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from pipeline.comparison.records import waits_for_towns, with_towns
from pipeline.comparison.runs import TRAIN, ArmRun, Comparison
from pipeline.engine.plan import Plan


@dataclass(frozen=True, slots=True)
class DryRun:
    """What one run would make.

    Attributes:
        run: Which, in words.
        makes: Stages that are not made, nor by a run before it.
        note: What it waits for.
    """

    run: str
    makes: tuple[str, ...]
    note: str


def plan_dry_run(comparison: Comparison, arm_runs: Sequence[ArmRun]) -> list[DryRun]:
    """Tell what each run would make.

    Raises:
        ConfigError: for records that are not there.
    """
    files = waits_for_towns(comparison)
    note = f"after {files} files of towns are written" if files else ""
    ahead = _DryRunner(comparison if files else with_towns(comparison), bool(files))
    return [ahead.look(arm_run, note) for arm_run in arm_runs]


@dataclass(frozen=True, slots=True)
class _DryRunner:
    """What runs would have made before others.

    Attributes:
        comparison: How they are planned.
        sketched: Whether there are no records yet.
        done: Stages that are made by then, by name and key.
        weights: Keys of the weights that are there, by arm and seed.
    """

    comparison: Comparison
    sketched: bool
    done: set[tuple[str, str]] = field(default_factory=set)
    weights: dict[tuple[str, int], str] = field(default_factory=dict)

    def look(self, arm_run: ArmRun, note: str) -> DryRun:
        """Tell what one run would make; it counts as made for those after it."""
        start = self.weights.get((arm_run.arm.starts_from or "", arm_run.seed))
        plan = self._plan(arm_run, start)
        keys = {name: planned.key for name, planned in plan.stages.items()}
        waits = arm_run.arm.starts_from is not None and start is None and TRAIN in keys
        if waits:  # Its keys follow from weights that are not there; these stand for them.
            keys |= {
                name: f"{arm_run.arm.name} {keys[name]}" for name in plan.after([TRAIN])
            }
        root = self.comparison.root
        makes = tuple(
            name
            for name, key in keys.items()
            if (name, key) not in self.done and not root.is_finished(name, key)
        )
        if TRAIN in keys and root.is_finished(TRAIN, keys[TRAIN]):
            self.weights[arm_run.arm.name, arm_run.seed] = keys[TRAIN]
        self.done.update(keys.items())
        return DryRun(
            arm_run.words, makes, f"after {arm_run.arm.starts_from}" if waits else note
        )

    def _plan(self, arm_run: ArmRun, start: str | None) -> Plan:
        sketched, comparison = self.sketched, self.comparison
        return comparison.sketch(arm_run) if sketched else comparison.plan(arm_run, start)
