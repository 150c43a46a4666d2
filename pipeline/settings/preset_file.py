"""Reading presets from ``stages.yaml``; errors name the line."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from infgen.errors import ConfigError
from infgen.views.published import ABLATIONS, PAPER
from pipeline.settings.lined_yaml import LinedMapping, did_you_mean, inner, known, words
from pipeline.settings.overlay import Overlay, merge_overlays, read_sections
from pipeline.settings.presets import SCENES_SHOWN, Arm, CurvePoint, Preset

if TYPE_CHECKING:
    from pipeline.settings.town_set import TownSet

COUNT_ERRORS = ("own", "split", "truth")
"""See ``infgen.metrics.long_term.table``: own log, mean of the split, same step."""
_PRESET = (
    *("profile", "seeds", "count_error", "towns", "rollout_sets", "arms"),
    "curve_axis",
)
_ARM = ("profile", "published", "label", "starts_from", "ablates", "rollout_sets", "curve")
_RULES_ARM = ("label", "rules_of", "rollout")
"""Keys of an arm that simulates the weights of another one with other rules."""
_METHODS = tuple(each.method for each in PAPER)


def read_preset(
    presets: LinedMapping, name: str, sections: Sequence[str], profiles: Sequence[str]
) -> Preset:
    """Read one preset.

    Args:
        presets: All of them, as YAML gave them.
        name: Which.
        sections: Sections of settings that there are.
        profiles: Profiles that there are.

    Raises:
        ConfigError: naming file, line, and what was expected there.
    """
    entry = inner(presets, name)
    _check_name(presets, name, "preset")
    known(entry, (*_PRESET, *sections), name)
    context = _settings(entry, sections)
    rollout_sets = {
        rollout_set: _only_settings(inner(entry, "rollout_sets"), rollout_set, sections)
        for rollout_set in inner(entry, "rollout_sets")
    }
    for rollout_set in rollout_sets:
        _check_name(inner(entry, "rollout_sets"), rollout_set, "rollout set")
    arms = {
        arm: _arm(
            inner(entry, "arms"), arm, _Context(context, rollout_sets, sections, profiles)
        )
        for arm in inner(entry, "arms")
    }
    if not arms:
        raise ConfigError(f"{presets.where(name)}: preset {name!r} has no arms")
    _check_arms(arms)
    return Preset(
        name=name,
        profile=_profile(entry, profiles),
        seeds=_seeds(entry),
        count_error=_word(entry, "count_error", COUNT_ERRORS) or COUNT_ERRORS[0],
        towns={
            split: _town_set(inner(entry, "towns"), split)
            for split in inner(entry, "towns")
        },
        arms={name: arms[name] for name in _ordered(arms)},
        curve_axis=_word(entry, "curve_axis", ()) or SCENES_SHOWN,
    )


@dataclass(frozen=True, slots=True)
class _Context:
    """What arms may name, and the settings that they are laid over."""

    settings: Overlay
    rollout_sets: Mapping[str, Overlay]
    sections: Sequence[str]
    profiles: Sequence[str]


def _arm(arms: LinedMapping, name: str, context: _Context) -> Arm:
    entry = inner(arms, name)
    _check_name(arms, name, "arm")
    if "rules_of" in entry:
        return _rules_arm(arms, name, context)
    known(entry, (*_ARM, *context.sections), name)
    published = _word(entry, "published", (*_METHODS, *ABLATIONS))
    settings = merge_overlays([context.settings, _settings(entry, context.sections)])
    own = _own_rollout_sets(entry, tuple(context.rollout_sets), context.sections)
    return Arm(
        name=name,
        label=_word(entry, "label", ()) or published or name,
        profile=_profile(entry, context.profiles),
        settings=settings,
        rollout_sets={
            rollout_set: merge_overlays([settings, context.rollout_sets[rollout_set], over])
            for rollout_set, over in own.items()
        },
        starts_from=_word(entry, "starts_from", tuple(arms)),
        ablates=_word(entry, "ablates", tuple(arms)),
        rules_of=None,
        published=published,
        where=arms.where(name),
        curve=_curve_point(entry),
    )


def _curve_point(entry: LinedMapping) -> CurvePoint | None:
    """Read which point of a learning curve an arm is."""
    if "curve" not in entry:
        return None
    given = inner(entry, "curve")
    known(given, ("line", "at"), "curve")
    line, at = _word(given, "line", ()), given.get("at")
    if line is None:
        raise ConfigError(f"{entry.where('curve')}: curve names no line")
    if at is not None and (isinstance(at, bool) or not isinstance(at, int) or at < 1):
        raise ConfigError(f"{given.where('at')}: at is {at!r}; expected 1 or more")
    return CurvePoint(line, at)


def _rules_arm(arms: LinedMapping, name: str, context: _Context) -> Arm:
    """Read an arm that has the weights of another one, and other settings of rollouts."""
    entry = inner(arms, name)
    known(entry, _RULES_ARM, name)
    of = _word(entry, "rules_of", tuple(arms))
    if of is None or "rules_of" in inner(arms, of):
        raise ConfigError(
            f"{entry.where('rules_of')}: rules_of is {of!r}; expected an arm with weights "
            "of its own"
        )
    base, own = _arm(arms, of, context), _settings(entry, context.sections)
    return replace(
        base,
        name=name,
        label=_word(entry, "label", ()) or base.label,
        settings=merge_overlays([base.settings, own]),
        rollout_sets={
            rollout_set: merge_overlays([settings, own])
            for rollout_set, settings in base.rollout_sets.items()
        },
        ablates=None,
        rules_of=of,
        published=None,
        curve=None,
        where=arms.where(name),
    )


def _own_rollout_sets(
    entry: LinedMapping, rollout_sets: Sequence[str], sections: Sequence[str]
) -> dict[str, Overlay]:
    """Read the rollout sets of an arm: a list of names, or settings by name."""
    given = entry.get("rollout_sets")
    if isinstance(given, LinedMapping):
        known(given, rollout_sets, "rollout_sets")
        return {
            rollout_set: _only_settings(given, rollout_set, sections)
            for rollout_set in given
        }
    for rollout_set in words(entry, "rollout_sets"):
        if rollout_set not in rollout_sets:
            where = entry.where("rollout_sets")
            near = did_you_mean(rollout_set, rollout_sets)
            raise ConfigError(f"{where}: no rollout set {rollout_set!r}{near}")
    return {rollout_set: Overlay((), {}) for rollout_set in words(entry, "rollout_sets")}


def _only_settings(mapping: LinedMapping, key: str, sections: Sequence[str]) -> Overlay:
    entry = inner(mapping, key)
    known(entry, sections, key)
    return _settings(entry, sections)


def _settings(entry: LinedMapping, sections: Sequence[str]) -> Overlay:
    """Read the sections of settings of an entry that has other keys too."""
    own = LinedMapping(entry.file)
    for key in entry:
        if key in sections:
            own[key], own.lines[key] = entry[key], entry.lines[key]
    overlay = read_sections(own, sections)
    for section in overlay.values.values():
        for key, given in section.items():
            if not isinstance(given.value, str | int | float):
                raise ConfigError(
                    f"{given.where}.{key} is {given.value!r}; expected a number, a word, "
                    "true or false"
                )
    return overlay


def _profile(entry: LinedMapping, profiles: Sequence[str]) -> tuple[str, ...]:
    given = entry.get("profile", "")
    names = [part.strip() for part in str(given).split(",")] if given else []
    for name in names:
        if name not in profiles:
            where = entry.where("profile")
            raise ConfigError(f"{where}: no profile {name!r}{did_you_mean(name, profiles)}")
    return tuple(names)


def _seeds(entry: LinedMapping) -> int:
    seeds = entry.get("seeds", 1)
    if not isinstance(seeds, int) or isinstance(seeds, bool) or seeds < 1:
        raise ConfigError(f"{entry.where('seeds')}: seeds is {seeds!r}; expected 1 or more")
    return seeds


def _word(entry: LinedMapping, key: str, there: Sequence[str]) -> str | None:
    """Read a word: one of ``there`` unless that is empty."""
    given = entry.get(key)
    if given is None:
        return None
    if not isinstance(given, str):
        raise ConfigError(f"{entry.where(key)}: {key} is {given!r}; expected a word")
    if there and given not in there:
        raise ConfigError(
            f"{entry.where(key)}: no {key} {given!r}{did_you_mean(given, there)}"
        )
    return given


def _check_name(mapping: LinedMapping, name: str, what: str) -> None:
    """Refuse a name that cannot be part of a file name."""
    if not re.fullmatch(r"[\w-]+", name):
        raise ConfigError(
            f"{mapping.where(name)}: {what} {name!r}; expected letters, digits, - and _"
        )


def _town_set(towns: LinedMapping, split: str) -> "TownSet":
    from infgen.settings import build  # noqa: PLC0415  # Pydantic takes 0.1 s.
    from pipeline.settings.town_set import TownSet  # noqa: PLC0415

    return build(TownSet, inner(towns, split), f"{towns.where(split)}: {split}")


def _check_arms(arms: Mapping[str, Arm]) -> None:
    for arm in arms.values():
        if arm.name in (arm.starts_from, arm.ablates):
            raise ConfigError(f"{arm.where}: arm {arm.name!r} names itself")


def _ordered(arms: Mapping[str, Arm]) -> list[str]:
    """Names of arms, each after the one it starts from."""
    order: list[str] = []
    for name in arms:
        chain = [name]
        while (start := arms[chain[-1]].starts_from) is not None:
            if start in chain:
                circle = " -> ".join([*chain, start])
                raise ConfigError(f"{arms[name].where}: arms start each other: {circle}")
            chain.append(start)
        order += [each for each in reversed(chain) if each not in order]
    return order
