"""The runs that a preset is made of: every arm with every seed, and all its rollout sets.

Runs share what they have in common: their stages have keys, so records are read once, and
weights are trained once for all rollout sets of an arm.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from infgen.config import TrainSettings
from infgen.errors import ConfigError
from pipeline.engine.atomic import write_json
from pipeline.engine.layout import Root
from pipeline.engine.plan import SOURCES, Plan, make_plan, stages_in_order
from pipeline.settings.overlay import Overlay, SettingValue, merge_overlays, read_overrides
from pipeline.settings.presets import Arm, Preset
from pipeline.settings.request import Request, read_request, request_file
from pipeline.settings.stages_file import DEFAULT_FILE, StagesFile
from pipeline.storage.initial_weights import BUILTIN

TRAIN, ROLLOUT, SCORE, REPORT = "train", "rollout", "score", "report"
PRESET = "preset"
PAGE, SHOWN = "comparison.html", "tables.json"
"""What a comparison shows: a page, and ``{name: {"title", "columns", "rows"}}``."""
_SEEDED = (TRAIN, ROLLOUT)
_NO_SEED = "the seeds of a preset are numbered from 0: --seeds says how many"


@dataclass(frozen=True, slots=True)
class ArmRun:
    """One arm with one seed, and one of its rollout sets.

    Attributes:
        preset: Name of the preset.
        arm: The arm.
        seed: Of its training and of its rollouts.
        rollout_set: Name of the rollout set; empty where only what is before it is wanted.
    """

    preset: str
    arm: Arm
    seed: int
    rollout_set: str = ""

    @property
    def name(self) -> str:
        """Its name in the root's memory; fit for a file."""
        parts = (PRESET, self.preset, self.arm.name, str(self.seed), self.rollout_set)
        return ".".join(part for part in parts if part)

    @property
    def words(self) -> str:
        """What it is, in words."""
        parts = (self.arm.name, f"seed {self.seed}", self.rollout_set)
        return ", ".join(part for part in parts if part)

    @property
    def settings(self) -> Overlay:
        """What the arm and its rollout set set."""
        return (
            self.arm.rollout_sets[self.rollout_set]
            if self.rollout_set
            else self.arm.settings
        )


@dataclass(frozen=True, slots=True)
class Comparison:
    """A requested comparison: how all its runs are planned.

    Attributes:
        root: Where they are made.
        path: The ``stages.yaml``.
        file: The same, read.
        preset: The comparison.
        profile: What the command lays over every arm; None for none.
        overrides: The same, as ``section.key=value`` words.
        records: Source files; empty to use those that the file or a profile names.
        targets: Stages to make.
    """

    root: Root
    path: Path
    file: StagesFile
    preset: Preset
    profile: str | None
    overrides: tuple[str, ...]
    records: tuple[str, ...]
    targets: tuple[str, ...]

    def with_records(self, records: Sequence[str]) -> "Comparison":
        """Replace the source files."""
        return replace(self, records=tuple(records))

    def plan(self, arm_run: ArmRun, start: str | None = None) -> Plan:
        """Plan one run.

        Args:
            arm_run: Which.
            start: Key of the weights that it goes on from.

        Raises:
            ConfigError: for settings that cannot be, or source files that are not there.
        """
        chosen = self._chosen(arm_run, start)
        return make_plan(self.root, self.file.stages, chosen, self._targets(arm_run))

    def sketch(self, arm_run: ArmRun) -> Plan:
        """Plan one run as if there were no records; its keys are only good to compare.

        Raises:
            ConfigError: for settings that cannot be.
        """
        stages = {
            name: replace(entry, deps=tuple(dep for dep in entry.deps if dep != SOURCES))
            for name, entry in self.file.stages.items()
        }
        return make_plan(
            self.root, stages, self._chosen(arm_run, None), self._targets(arm_run)
        )

    def request(self, arm_run: ArmRun, start: str | None = None) -> Request:
        """Return one run as a request of its own."""
        over = merge_overlays(self._over(arm_run, start))
        return Request(
            root=self.root,
            file=self.path,
            profile=self._profile(arm_run),
            records=self.records or over.sources,
            overrides=over.words,
        )

    @property
    def stages(self) -> list[str]:
        """Stages that its runs make, each after those it reads."""
        return stages_in_order(self.file.stages, self._last)

    def remember(self, keys: Mapping[str, str]) -> None:
        """Remember the request in the root, for commands without options."""
        name = f"{PRESET}.{self.preset.name}"
        about = {
            "records": self.records,
            "file": None if self.path == DEFAULT_FILE else str(self.path),
            "keys": {**read_request(self.root, name).get("keys", {}), **keys},
        }
        path = request_file(self.root, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, about)

    @property
    def _last(self) -> list[str]:
        """The targets; what a report would show is for the comparison to show."""
        return [SCORE if target == REPORT else target for target in self.targets]

    def _targets(self, arm_run: ArmRun) -> list[str]:
        weights_only = not arm_run.rollout_set and ROLLOUT in self.stages
        return [TRAIN] if weights_only else self._last

    def _chosen(self, arm_run: ArmRun, start: str | None) -> Overlay:
        over = self._over(arm_run, start)
        chosen = self.file.choose(self._profile(arm_run), between=over)
        return chosen.with_sources(self.records) if self.records else chosen

    def _profile(self, arm_run: ArmRun) -> str | None:
        return ",".join([*self.preset.profile, *arm_run.arm.profile]) or None

    def _over(self, arm_run: ArmRun, start: str | None) -> list[Overlay]:
        """What is laid over the profiles, from the bottom up."""
        own: dict[str, dict[str, SettingValue]] = {
            section: {"seed": SettingValue(arm_run.seed, f"--seeds: {section}")}
            for section in _SEEDED
        }
        words = read_overrides(self.overrides, self.file.sections)
        for section in _SEEDED:
            if "seed" in words.values.get(section, {}):
                raise ConfigError(f"-s {section}.seed: {_NO_SEED}")
        over = [arm_run.settings, *self.file.profile_overlays(self.profile), words]
        start = start or self._stand_in(arm_run, over)
        if start is not None:
            own[TRAIN]["initial_weights"] = SettingValue(
                start, f"weights of arm {arm_run.arm.starts_from}: {TRAIN}"
            )
        return [*over, Overlay((), own)]

    def _stand_in(self, arm_run: ArmRun, over: list[Overlay]) -> str | None:
        """Weights to plan with while those that the arm starts from are not there.

        None leaves the setting as it is; only policy gradient cannot do without any.
        """
        if arm_run.arm.starts_from is None:
            return None
        chosen = self.file.choose(self._profile(arm_run), between=over)
        how = chosen.build(TRAIN, TrainSettings)
        return BUILTIN if how.policy_gradient_rollouts else None


def arm_runs_of(comparison: Comparison, arms: Sequence[Arm], seeds: int) -> list[ArmRun]:
    """List all runs, in an order in which each finds the weights that it goes on from.

    Every seed is done with before the next one: there is something to look at early.

    Args:
        comparison: How they are planned.
        arms: Arms that are compared; those that they go on from are trained too.
        seeds: How many.
    """
    rollout_sets = ROLLOUT in comparison.stages
    starts = comparison.preset.initial_arms(arms)
    found = []
    for seed in range(seeds):
        for arm in comparison.preset.arms.values():
            if arm in starts or (arm in arms and not rollout_sets):
                found.append(ArmRun(comparison.preset.name, arm, seed))
            elif arm in arms:
                found += [
                    ArmRun(comparison.preset.name, arm, seed, rollout_set)
                    for rollout_set in arm.rollout_sets
                ]
    return found
