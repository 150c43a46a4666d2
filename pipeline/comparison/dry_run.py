"""What the runs of a comparison would still make. Looks only; writes nothing."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from pipeline.comparison.records import waits_for_towns, with_towns
from pipeline.comparison.runs import TRAIN, Comparison, Leg
from pipeline.engine.plan import Plan


@dataclass(frozen=True, slots=True)
class Outlook:
    """What one run would make.

    Attributes:
        run: Which, in words.
        makes: Stages that are not made, nor by a run before it.
        note: What it waits for.
    """

    run: str
    makes: tuple[str, ...]
    note: str


def look_ahead(comparison: Comparison, legs: Sequence[Leg]) -> list[Outlook]:
    """Tell what each run would make.

    Raises:
        ConfigError: for records that are not there.
    """
    files = waits_for_towns(comparison)
    note = f"after {files} files of towns are written" if files else ""
    ahead = _Ahead(comparison if files else with_towns(comparison), bool(files))
    return [ahead.look(leg, note) for leg in legs]


@dataclass(frozen=True, slots=True)
class _Ahead:
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

    def look(self, leg: Leg, note: str) -> Outlook:
        """Tell what one run would make; it counts as made for those after it."""
        start = self.weights.get((leg.arm.starts_from or "", leg.seed))
        plan = self._plan(leg, start)
        keys = {name: planned.key for name, planned in plan.stages.items()}
        waits = leg.arm.starts_from is not None and start is None and TRAIN in keys
        if waits:  # Its keys follow from weights that are not there; these stand for them.
            keys |= {name: f"{leg.arm.name} {keys[name]}" for name in plan.after([TRAIN])}
        root = self.comparison.root
        makes = tuple(
            name
            for name, key in keys.items()
            if (name, key) not in self.done and not root.is_finished(name, key)
        )
        if TRAIN in keys and root.is_finished(TRAIN, keys[TRAIN]):
            self.weights[leg.arm.name, leg.seed] = keys[TRAIN]
        self.done.update(keys.items())
        return Outlook(leg.words, makes, f"after {leg.arm.starts_from}" if waits else note)

    def _plan(self, leg: Leg, start: str | None) -> Plan:
        sketched, comparison = self.sketched, self.comparison
        return comparison.sketch(leg) if sketched else comparison.plan(leg, start)
