"""Making all runs of a comparison, one after the other; a failed one stops no other.

Each is a normal run of the engine: cached, resumable, locked, in the same log.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from pipeline.comparison.runs import TRAIN, ArmRun, Comparison
from pipeline.engine.atomic import StoreError
from pipeline.engine.events import Events
from pipeline.engine.plan import Plan
from pipeline.engine.runner import RunOptions, StageResult, run

State = Literal["cached", "made", "failed", "skipped"]


@dataclass(frozen=True, slots=True)
class ExecutedRun:
    """What became of one run.

    Attributes:
        arm_run: Which.
        state: ``made`` if anything was, ``skipped`` if it could not be begun.
        why: What failed, or what it waits for.
        plan: Its stages; None if it could not be planned.
        results: What became of them.
    """

    arm_run: ArmRun
    state: State
    why: str = ""
    plan: Plan | None = None
    results: tuple[StageResult, ...] = ()

    @property
    def is_whole(self) -> bool:
        """Whether all requested stages are made."""
        return self.state in ("cached", "made")

    @property
    def keys(self) -> dict[str, str]:
        """Keys of its stages."""
        return {} if self.plan is None else {n: self.plan[n].key for n in self.plan.stages}

    @property
    def seconds(self) -> float:
        """Time it took."""
        return sum((result.seconds for result in self.results), 0.0)

    def to_json(self) -> dict[str, Any]:
        """Which it is, its keys, and what is wrong: the same whenever it was made."""
        return {
            "arm": self.arm_run.arm.name,
            "seed": self.arm_run.seed,
            "rollout_set": self.arm_run.rollout_set,
            "keys": self.keys,
            "missing": self.why if not self.is_whole else "",
        }


def execute_arm_runs(
    comparison: Comparison,
    arm_runs: Sequence[ArmRun],
    run_options: Callable[[Plan], RunOptions],
    events: Events,
) -> list[ExecutedRun]:
    """Make all runs that can be made.

    Args:
        comparison: How they are planned.
        arm_runs: The runs, each after those whose weights it goes on from.
        run_options: How each is run.
        events: Receives all events.

    Raises:
        ConfigError: for settings that cannot be, of any of them, before the first.
        LockedError: if another run makes one of their stages.
    """
    for arm_run in arm_runs:  # Days may lie before the last of them.
        comparison.plan(arm_run, None)
    runs = _Runs(comparison, run_options, events)
    ran: list[ExecutedRun] = []
    for arm_run in arm_runs:
        events.emit(
            "arm-run-started",
            arm_run=arm_run.words,
            number=len(ran) + 1,
            arm_runs=len(arm_runs),
        )
        ran.append(runs.run(arm_run))
        if ran[-1].why:
            events.emit("arm-run-failed", arm_run=arm_run.words, why=ran[-1].why)
    return ran


@dataclass(slots=True)
class _Runs:
    """What earlier runs leave to later ones.

    Attributes:
        weights: Key of the weights of each arm and seed that are there.
        failed: Why a stage with a key could not be made; it is not tried again.
        remade: Stages that were made again, as is done once only.
    """

    comparison: Comparison
    run_options: Callable[[Plan], RunOptions]
    events: Events
    weights: dict[tuple[str, int], str] = field(default_factory=dict)
    failed: dict[tuple[str, str], str] = field(default_factory=dict)
    remade: set[tuple[str, str]] = field(default_factory=set)

    def run(self, arm_run: ArmRun) -> ExecutedRun:
        start = None
        if arm_run.arm.starts_from is not None and TRAIN in self.comparison.stages:
            start = self.weights.get((arm_run.arm.starts_from, arm_run.seed))
            if start is None:
                return ExecutedRun(
                    arm_run, "skipped", f"there are no weights of {arm_run.arm.starts_from}"
                )
        plan = self.comparison.plan(arm_run, start)
        for stage, planned in plan.stages.items():
            if (stage, planned.key) in self.failed:
                return ExecutedRun(
                    arm_run, "skipped", self.failed[stage, planned.key], plan
                )
        try:
            with self.comparison.request(arm_run, start).remembered(plan, arm_run.name):
                results = run(plan, self._orders(plan), self.events)
        except StoreError as error:
            return ExecutedRun(arm_run, "failed", str(error), plan)
        return self._note(arm_run, plan, results)

    def _orders(self, plan: Plan) -> RunOptions:
        """Make nothing again that was made again in this call."""
        run_options = self.run_options(plan)
        again = plan.after(run_options.force & plan.stages.keys())
        left = {name for name in again if (name, plan[name].key) not in self.remade}
        return replace(run_options, force=frozenset(left))

    def _note(
        self, arm_run: ArmRun, plan: Plan, results: Sequence[StageResult]
    ) -> ExecutedRun:
        why = ""
        for result in results:
            key = (result.stage, result.key)
            if result.state == "failed":
                unit, error = next(iter(result.errors.items()))
                self.failed[key] = f"{result.stage}: {unit}: {error}"
                why = why or self.failed[key]
            if result.state == "made":
                self.remade.add(key)
            if result.stage == TRAIN and result.state in ("cached", "made"):
                self.weights[arm_run.arm.name, arm_run.seed] = result.key
        made = any(result.state == "made" for result in results)
        state: State = "failed" if why else "made" if made else "cached"
        return ExecutedRun(arm_run, state, why, plan, tuple(results))
