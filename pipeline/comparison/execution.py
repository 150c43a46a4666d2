"""Making all runs of a comparison, one after the other; a failed one stops no other.

Each is a normal run of the engine: cached, resumable, locked, told to the same log.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from pipeline.comparison.runs import TRAIN, Comparison, Leg
from pipeline.engine.atomic import StoreError
from pipeline.engine.events import Events
from pipeline.engine.plan import Plan
from pipeline.engine.runner import RunOptions, StageResult, run

State = Literal["cached", "made", "failed", "skipped"]


@dataclass(frozen=True, slots=True)
class Ran:
    """What became of one run.

    Attributes:
        leg: Which.
        state: ``made`` if anything was, ``skipped`` if it could not be begun.
        why: What failed, or what it waits for.
        plan: Its stages; None if it could not be planned.
        results: What became of them.
    """

    leg: Leg
    state: State
    why: str = ""
    plan: Plan | None = None
    results: tuple[StageResult, ...] = ()

    @property
    def is_whole(self) -> bool:
        """Whether all that was asked for is there."""
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
            "arm": self.leg.arm.name,
            "seed": self.leg.seed,
            "play": self.leg.play,
            "keys": self.keys,
            "missing": self.why if not self.is_whole else "",
        }


def run_legs(
    comparison: Comparison,
    legs: Sequence[Leg],
    run_options: Callable[[Plan], RunOptions],
    events: Events,
) -> list[Ran]:
    """Make all runs that can be made.

    Args:
        comparison: How they are planned.
        legs: The runs, each after those whose weights it goes on from.
        run_options: How each is run.
        events: Told of everything.

    Raises:
        ConfigError: for settings that cannot be, of any of them, before the first.
        LockedError: if another run makes one of their stages.
    """
    for leg in legs:  # Days may lie before the last of them.
        comparison.plan(leg, None)
    runs = _Runs(comparison, run_options, events)
    ran: list[Ran] = []
    for leg in legs:
        events.emit("leg-started", leg=leg.words, number=len(ran) + 1, legs=len(legs))
        ran.append(runs.run(leg))
        if ran[-1].why:
            events.emit("leg-failed", leg=leg.words, why=ran[-1].why)
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

    def run(self, leg: Leg) -> Ran:
        start = None
        if leg.arm.starts_from is not None and TRAIN in self.comparison.stages:
            start = self.weights.get((leg.arm.starts_from, leg.seed))
            if start is None:
                return Ran(leg, "skipped", f"there are no weights of {leg.arm.starts_from}")
        plan = self.comparison.plan(leg, start)
        for stage, planned in plan.stages.items():
            if (stage, planned.key) in self.failed:
                return Ran(leg, "skipped", self.failed[stage, planned.key], plan)
        try:
            with self.comparison.request(leg, start).remembered(plan, leg.name):
                results = run(plan, self._orders(plan), self.events)
        except StoreError as error:
            return Ran(leg, "failed", str(error), plan)
        return self._note(leg, plan, results)

    def _orders(self, plan: Plan) -> RunOptions:
        """Make nothing again that was made again in this call."""
        run_options = self.run_options(plan)
        again = plan.after(run_options.force & plan.stages.keys())
        left = {name for name in again if (name, plan[name].key) not in self.remade}
        return replace(run_options, force=frozenset(left))

    def _note(self, leg: Leg, plan: Plan, results: Sequence[StageResult]) -> Ran:
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
                self.weights[leg.arm.name, leg.seed] = result.key
        made = any(result.state == "made" for result in results)
        state: State = "failed" if why else "made" if made else "cached"
        return Ran(leg, state, why, plan, tuple(results))
