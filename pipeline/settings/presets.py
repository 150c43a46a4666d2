"""Presets of ``stages.yaml``: methods that are trained, simulated and scored side by side.

::

    presets:
      towns-benchmark:
        profile: small,benchmark        # below all that follows
        seeds: 3                        # 0, 1 and 2
        count_error: truth              # what agent counts are compared with
        towns:                          # used where no records are named
          training: {scenes: 2000, seconds: 9.1}
        rollout_sets:                          # settings of rollouts, by name
          long: {rollout: {mode: long}}
          wosac: {rollout: {mode: wosac, count: 32}}
        arms:
          infgen: {published: InfGen, rollout_sets: [long, wosac]}
          smart:
            profile: smart              # over the preset's profile
            rollout_sets: {long: {score: {presence_radius_m: 75}}, wosac: {}}
          catk: {profile: "smart,closed-loop", starts_from: smart, rollout_sets: [long]}
          no-cell: {profile: no-position-token, ablates: infgen, rollout_sets: [long]}
          infgen-safe: {rules_of: infgen, rollout: {rules: safe}}  # made if it is named
          twice: {starts_from: infgen, curve: {line: InfGen}, rollout_sets: [long]}

Settings may be given in the preset, in an arm, in a rollout set, and in a rollout set of an
arm. Each takes precedence over those before it, and all of them over the profiles.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from infgen.errors import ConfigError
from pipeline.settings.lined_yaml import did_you_mean
from pipeline.settings.overlay import Overlay

if TYPE_CHECKING:
    from pipeline.settings.town_set import TownSet

SCENES_SHOWN = "scenes shown in training"


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """A point of a learning curve.

    Attributes:
        line: Name of the line that it is on.
        at: Its place on the axis; None for the scenes that training has shown, those of
            the arms that it starts from among them.
    """

    line: str
    at: int | None = None


@dataclass(frozen=True, slots=True)
class Arm:
    """One method of a comparison.

    Attributes:
        name: As on the command line.
        label: Its name in tables.
        profile: Profiles over those of the preset.
        settings: Settings over all profiles.
        rollout_sets: Settings of each of its rollout sets over all profiles, by name.
        starts_from: Arm whose weights its training starts from.
        ablates: Arm that it is an ablation of; it is then listed in the table of ablations.
        rules_of: Arm whose weights and rollout sets it has, with other settings of
            rollouts. It is made only if it is named, and listed in the table of rules only.
        published: Row of the paper that it is compared with.
        curve: Point of a learning curve that it is; None for none.
        where: Its place in the file.
    """

    name: str
    label: str
    profile: tuple[str, ...]
    settings: Overlay
    rollout_sets: Mapping[str, Overlay]
    starts_from: str | None
    ablates: str | None
    rules_of: str | None
    published: str | None
    where: str
    curve: CurvePoint | None = None


@dataclass(frozen=True, slots=True)
class Preset:
    """A comparison of methods.

    Attributes:
        name: As on the command line.
        profile: Profiles of all arms.
        seeds: Number of seeds with which every arm is trained and simulated.
        count_error: What agent counts in its tables are compared with.
        towns: Synthetic towns, by split, used where no records are named.
        arms: Its methods by name, each after the one it starts from.
        curve_axis: What the axis of its learning curve is.
    """

    name: str
    profile: tuple[str, ...]
    seeds: int
    count_error: str
    towns: "Mapping[str, TownSet]"
    arms: Mapping[str, Arm]
    curve_axis: str = SCENES_SHOWN

    def chosen(self, names: Sequence[str]) -> list[Arm]:
        """Pick arms by name; without names all but those that show what rules change.

        Raises:
            ConfigError: for an arm that does not exist.
        """
        for name in names:
            if name not in self.arms:
                there = did_you_mean(name, list(self.arms))
                raise ConfigError(f"--arms {name}: no arm {name!r} in {self.name}{there}")
        return [
            arm
            for name, arm in self.arms.items()
            if (name in names if names else arm.rules_of is None)
        ]

    def initial_arms(self, arms: Sequence[Arm]) -> list[Arm]:
        """Return arms that these start from and that are not among them, in order."""
        have = {arm.name for arm in arms}
        needed: set[str] = set()
        for arm in arms:
            start = arm.starts_from
            while start is not None:
                needed.add(start)
                start = self.arms[start].starts_from
        return [arm for name, arm in self.arms.items() if name in needed - have]
