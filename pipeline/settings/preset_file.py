"""Presets as ``stages.yaml`` has them, read with the lines that things stand in."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from infgen.coerce import build
from infgen.config import ConfigError
from infgen.views.published import ABLATIONS, PAPER
from pipeline.settings.lined_yaml import Lined, hint, inner, known, words
from pipeline.settings.overlay import Overlay, lay, read_values
from pipeline.settings.presets import Arm, Preset, TownSet

COUNT_ERRORS = ("own", "split", "truth")
"""See ``infgen.metrics.long_term.table``: own log, mean of the split, same step."""
_PRESET = ("profile", "seeds", "count_error", "towns", "plays", "arms")
_ARM = ("profile", "published", "label", "start", "ablates", "plays")
_METHODS = tuple(each.method for each in PAPER)


def read_preset(
    presets: Lined, name: str, sections: Sequence[str], profiles: Sequence[str]
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
    below = _settings(entry, sections)
    plays = {
        play: _only_settings(inner(entry, "plays"), play, sections)
        for play in inner(entry, "plays")
    }
    for play in plays:
        _check_name(inner(entry, "plays"), play, "play")
    arms = {
        arm: _arm(inner(entry, "arms"), arm, _Below(below, plays, sections, profiles))
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
            split: build(TownSet, inner(inner(entry, "towns"), split), where)
            for split, where in _places(inner(entry, "towns"))
        },
        arms={name: arms[name] for name in _ordered(arms)},
    )


@dataclass(frozen=True, slots=True)
class _Below:
    """What arms may name: plays, sections and profiles; and what they are laid over."""

    settings: Overlay
    plays: Mapping[str, Overlay]
    sections: Sequence[str]
    profiles: Sequence[str]


def _arm(arms: Lined, name: str, below: _Below) -> Arm:
    entry = inner(arms, name)
    _check_name(arms, name, "arm")
    known(entry, (*_ARM, *below.sections), name)
    published = _word(entry, "published", (*_METHODS, *ABLATIONS))
    settings = lay([below.settings, _settings(entry, below.sections)])
    own = _own_plays(entry, tuple(below.plays), below.sections)
    return Arm(
        name=name,
        label=_word(entry, "label", ()) or published or name,
        profile=_profile(entry, below.profiles),
        settings=settings,
        plays={
            play: lay([settings, below.plays[play], over]) for play, over in own.items()
        },
        start=_word(entry, "start", tuple(arms)),
        ablates=_word(entry, "ablates", tuple(arms)),
        published=published,
        where=arms.where(name),
    )


def _own_plays(
    entry: Lined, plays: Sequence[str], sections: Sequence[str]
) -> dict[str, Overlay]:
    """Read which plays an arm has: a list of names, or settings by name."""
    given = entry.get("plays")
    if isinstance(given, Lined):
        known(given, plays, "plays")
        return {play: _only_settings(given, play, sections) for play in given}
    for play in words(entry, "plays"):
        if play not in plays:
            where = entry.where("plays")
            raise ConfigError(f"{where}: no play {play!r}{hint(play, plays)}")
    return {play: Overlay((), {}) for play in words(entry, "plays")}


def _only_settings(mapping: Lined, key: str, sections: Sequence[str]) -> Overlay:
    entry = inner(mapping, key)
    known(entry, sections, key)
    return _settings(entry, sections)


def _settings(entry: Lined, sections: Sequence[str]) -> Overlay:
    """Read the settings in an entry that holds other things too."""
    own = Lined(entry.file)
    for key in entry:
        if key in sections:
            own[key], own.lines[key] = entry[key], entry.lines[key]
    overlay = read_values(own, sections)
    for section in overlay.values.values():
        for key, given in section.items():
            if not isinstance(given.value, str | int | float):
                raise ConfigError(
                    f"{given.where}.{key} is {given.value!r}; expected a number, a word, "
                    "true or false"
                )
    return overlay


def _profile(entry: Lined, profiles: Sequence[str]) -> tuple[str, ...]:
    given = entry.get("profile", "")
    names = [part.strip() for part in str(given).split(",")] if given else []
    for name in names:
        if name not in profiles:
            where = entry.where("profile")
            raise ConfigError(f"{where}: no profile {name!r}{hint(name, profiles)}")
    return tuple(names)


def _seeds(entry: Lined) -> int:
    seeds = entry.get("seeds", 1)
    if not isinstance(seeds, int) or isinstance(seeds, bool) or seeds < 1:
        raise ConfigError(f"{entry.where('seeds')}: seeds is {seeds!r}; expected 1 or more")
    return seeds


def _word(entry: Lined, key: str, there: Sequence[str]) -> str | None:
    """Read a word; one of some, if there are any."""
    given = entry.get(key)
    if given is None:
        return None
    if not isinstance(given, str):
        raise ConfigError(f"{entry.where(key)}: {key} is {given!r}; expected a word")
    if there and given not in there:
        raise ConfigError(f"{entry.where(key)}: no {key} {given!r}{hint(given, there)}")
    return given


def _check_name(mapping: Lined, name: str, what: str) -> None:
    """Names become parts of file names."""
    if not re.fullmatch(r"[\w-]+", name):
        raise ConfigError(
            f"{mapping.where(name)}: {what} {name!r}; expected letters, digits, - and _"
        )


def _places(towns: Lined) -> list[tuple[str, str]]:
    for split in towns:
        for key in ("scenes", "seconds"):
            if key not in inner(towns, split):
                raise ConfigError(f"{towns.where(split)}: {split} needs {key}")
    return [(split, f"{towns.where(split)}: {split}") for split in towns]


def _check_arms(arms: Mapping[str, Arm]) -> None:
    for arm in arms.values():
        if arm.name in (arm.start, arm.ablates):
            raise ConfigError(f"{arm.where}: arm {arm.name!r} names itself")


def _ordered(arms: Mapping[str, Arm]) -> list[str]:
    """Names of arms, each after the one it goes on from."""
    order: list[str] = []
    for name in arms:
        chain = [name]
        while (start := arms[chain[-1]].start) is not None:
            if start in chain:
                circle = " -> ".join([*chain, start])
                raise ConfigError(f"{arms[name].where}: arms start each other: {circle}")
            chain.append(start)
        order += [each for each in reversed(chain) if each not in order]
    return order
