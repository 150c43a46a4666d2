"""All that a comparison found, in the words of its tables."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from infgen.views.sheets import Measured
from pipeline.comparison.execution import ExecutedRun
from pipeline.comparison.scores import Scored, read_logs, read_scored
from pipeline.comparison.statistics import Numbers, combine, ratio
from pipeline.settings.presets import Arm, Preset
from pipeline.stages.score.summary import Tally

LONG, MOTION_ONLY, OFFICIAL_PLAY = "long", "motion-only", "wosac"
"""Modes of rollouts: whose rollout set is which of the paper's tables."""
SUBJECT = "InfGen"
"""The paper's own method; the others are what it is held against."""


@dataclass(frozen=True)
class ComparisonResult:
    """What the runs of a preset have scored.

    Attributes:
        preset: The comparison.
        ran: All its runs.
        scored: Those that are whole, and played something.
        logs: Scores of the logs whose scenes were simulated.
        parts: The same of each split, where rollout sets are of several.
    """

    preset: Preset
    ran: Sequence[ExecutedRun]
    scored: Sequence[Scored]
    logs: Tally
    parts: Mapping[str, "ComparisonResult"] = field(default_factory=dict)

    @property
    def by_split(self) -> Mapping[str, "ComparisonResult"]:
        """What is compared with each other, by split; by an empty word if it is all."""
        return self.parts or {"": self}

    @cached_property
    def numbers(self) -> Numbers:
        """Every number over its seeds, by arm and rollout set."""
        return combine(self.scored)

    @property
    def missing(self) -> list[str]:
        """Runs that there are no numbers of, each with the reason."""
        return [f"{ran.arm_run.words}: {ran.why}" for ran in self.ran if not ran.is_whole]

    @property
    def seeds(self) -> list[int]:
        """Seeds that anything was scored with."""
        return sorted({one.seed for one in self.scored})

    @property
    def subject(self) -> Arm | None:
        """The method that the others are held against."""
        named = [arm for arm in self.methods if arm.published == SUBJECT]
        return next(iter(named or self.methods), None)

    @property
    def methods(self) -> list[Arm]:
        """Arms that are no ablation of another."""
        return [arm for arm in self.arms if arm.ablates is None]

    @property
    def arms(self) -> list[Arm]:
        """Arms that anything was scored of, but for those that show what rules change."""
        return [arm for arm in self._scored_arms if arm.rules_of is None]

    @property
    def rules_arms(self) -> list[Arm]:
        """Arms that show what rules change, if anything was scored of them."""
        return [arm for arm in self._scored_arms if arm.rules_of is not None]

    @property
    def _scored_arms(self) -> list[Arm]:
        have = {one.arm for one in self.scored}
        return [arm for arm in self.preset.arms.values() if arm.name in have]

    def runs(self, arm: Arm, mode: str) -> dict[str, list[Scored]]:
        """Runs of an arm that were simulated in one mode, by rollout set."""
        found: dict[str, list[Scored]] = {}
        for one in self.scored:
            if one.arm == arm.name and one.mode == mode:
                found.setdefault(one.rollout_set, []).append(one)
        return found

    def rows(
        self, arms: Sequence[Arm], mode: str
    ) -> Iterator[tuple[str, Mapping[str, Measured]]]:
        """Yield the numbers of some arms' rollout sets of one mode, each with its name."""
        for arm in arms:
            rollout_sets = self.runs(arm, mode)
            for rollout_set in rollout_sets:
                label = (
                    arm.label if len(rollout_sets) == 1 else f"{arm.label}, {rollout_set}"
                )
                yield label, self.numbers[arm.name, rollout_set]

    def first(self, arm: Arm, mode: str) -> Mapping[str, Measured]:
        """Return the numbers of an arm's first rollout set of a mode; none without any."""
        rollout_sets = self.runs(arm, mode)
        return self.numbers[arm.name, next(iter(rollout_sets))] if rollout_sets else {}

    def ratio(self, ours: Arm, theirs: Arm, mode: str, name: str) -> Measured:
        """Give one number of an arm as a multiple of another arm's."""
        one, other = (list(self.runs(arm, mode).values()) for arm in (ours, theirs))
        return ratio(one[0], other[0], name) if one and other else Measured(None)

    def to_json(self) -> dict[str, Any]:
        """Every number, and where it comes from."""
        combined: dict[str, Any] = {}
        for (arm, rollout_set), numbers in self.numbers.items():
            values = {name: one.to_json() for name, one in numbers.items()}
            combined.setdefault(arm, {})[rollout_set] = values
        return {
            "preset": self.preset.name,
            "seeds": self.seeds,
            "count_error": self.preset.count_error,
            "interval": self.interval,
            "records": self._records,
            "runs": [one.to_json() for one in self.scored],
            "missing": self.missing,
            "arms": combined,
        }

    @property
    def _records(self) -> dict[str, str]:
        """Identities of the source files, by name."""
        plans = [one.ran.plan for one in self.scored if one.ran.plan is not None]
        return {
            source.name: source.fingerprint
            for plan in plans[:1]
            for source in plan["ingest"].sources
        }

    @property
    def interval(self) -> str:
        """What the intervals are, in words."""
        if len(self.seeds) > 1:
            return (
                f"mean over {len(self.seeds)} seeds of training and playing; 95 % "
                "interval of that mean by Student's t"
            )
        times = {one.settings.bootstrap_resamples for one in self.scored}
        drawn = ", ".join(f"{each:,}" for each in sorted(times))
        return (
            "one seed; 95 % interval by drawing the scenes again with replacement "
            f"{drawn or 'no'} times, which says nothing of other seeds"
        )


def compare(preset: Preset, ran: Sequence[ExecutedRun]) -> ComparisonResult:
    """Read what all whole runs have scored.

    Raises:
        StoreError: if it is damaged.
    """
    scored = [
        read_scored(each) for each in ran if each.is_whole and each.arm_run.rollout_set
    ]
    splits = dict.fromkeys(one.measures.split for one in scored)
    parts = {
        split: _part(preset, ran, [one for one in scored if one.measures.split == split])
        for split in splits
    }
    if len(parts) == 1:
        return next(iter(parts.values()))
    return replace(_part(preset, ran, []), scored=scored, parts=parts)


def _part(
    preset: Preset, ran: Sequence[ExecutedRun], scored: Sequence[Scored]
) -> ComparisonResult:
    """Gather runs whose scenes are of one split, and the logs of these scenes."""
    scenes = dict.fromkeys(scene for one in scored for scene in one.tally.means)
    logs = read_logs(scored[0].ran, list(scenes)) if scored else Tally()
    return ComparisonResult(preset, ran, scored, logs)
