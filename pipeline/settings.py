"""``stages.yaml``: the stage graph, its settings, and the profiles laid over them.

::

    version: 1
    sources: ${INFGEN_RECORDS:-data/womd/*.tfrecord*}     # or a list of them
    stages:
      tokenize: {deps: [ingest, build-vocab], params: [tokenize]}
    params:
      tokenize: {max_gap_s: 1.0}
    profiles:
      small: {sources: builtin, train: {steps: 100}}

Profiles may be stacked: ``--profile small,paper-loss`` lays the second over the first.
A stage may name a ``module`` of its own that ends in ``STAGE = Stage(...)``.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from infgen.config import ConfigError
from pipeline.lined_yaml import Lined, load
from pipeline.stages import MODULES

FILE_VERSION = 1
DEFAULT_FILE = Path(__file__).with_name("default_stages.yaml")
SOURCES = "sources"
"""Among ``deps``: the stage reads the source files."""


@dataclass(frozen=True, slots=True)
class Value:
    """One value, and the place that gave it."""

    value: Any
    where: str


@dataclass(frozen=True, slots=True)
class StageEntry:
    """One stage of the graph.

    Attributes:
        name: As on the command line.
        module: Where its code is.
        deps: Stages that it reads, and ``sources``.
        params: Sections of settings that it reads.
        where: Its place in the file.
    """

    name: str
    module: str
    deps: tuple[str, ...]
    params: tuple[str, ...]
    where: str


@dataclass(frozen=True, slots=True)
class Overlay:
    """Settings by section, and source files; empty where nothing is said."""

    sources: tuple[str, ...]
    values: Mapping[str, Mapping[str, Value]]

    def with_sources(self, sources: tuple[str, ...]) -> "Overlay":
        """Replace the source files."""
        return Overlay(sources, self.values)


@dataclass(frozen=True, slots=True)
class StagesFile:
    """A whole ``stages.yaml``."""

    stages: Mapping[str, StageEntry]
    base: Overlay
    profiles: Mapping[str, Overlay]

    def choose(self, profile: str | None, overrides: Sequence[str] = ()) -> Overlay:
        """Lay profiles, and then ``section.key=value`` words, over the base.

        Args:
            profile: Names with commas between, each laid over those before it.
            overrides: The words.

        Raises:
            ConfigError: for a profile or section that does not exist.
        """
        layers = [self.base, *self._picked(profile)]
        layers.append(_overrides(overrides, self._sections()))
        values: dict[str, dict[str, Value]] = {}
        for layer in layers:
            for section, given in layer.values.items():
                values.setdefault(section, {}).update(given)
        sources = [layer.sources for layer in layers if layer.sources]
        return Overlay(sources[-1] if sources else (), values)

    def names_sources(self, profile: str | None) -> bool:
        """Whether one of the profiles says itself which source files it reads."""
        return any(overlay.sources for overlay in self._picked(profile))

    def _picked(self, profile: str | None) -> list[Overlay]:
        names = [] if profile is None else profile.split(",")
        return [
            _pick(self.profiles, name.strip(), "profile", "--profile") for name in names
        ]

    def _sections(self) -> list[str]:
        found = [section for entry in self.stages.values() for section in entry.params]
        return list(dict.fromkeys(found))


def load_stages(path: Path, environ: Mapping[str, str]) -> StagesFile:
    """Read a ``stages.yaml``.

    Args:
        path: The file.
        environ: Variables for ``${NAME:-default}`` in the paths of sources.

    Raises:
        ConfigError: naming file, line, and what was expected there.
    """
    file = load(path)
    _known(file, ("version", SOURCES, "stages", "params", "profiles"), path.name)
    if file.get("version") != FILE_VERSION:
        found = file.get("version")
        raise ConfigError(f"{path.name}: version is {found!r}, expected {FILE_VERSION}")
    stages = {name: _stage(file, name) for name in _inner(file, "stages")}
    sections = [section for entry in stages.values() for section in entry.params]
    return StagesFile(
        stages=stages,
        base=Overlay(_sources(file, environ), _values(_inner(file, "params"), sections)),
        profiles={
            name: _profile(_inner(_inner(file, "profiles"), name), sections, environ)
            for name in _inner(file, "profiles")
        },
    )


def _stage(file: Lined, name: str) -> StageEntry:
    entry = _inner(_inner(file, "stages"), name)
    where = _inner(file, "stages").where(name)
    _known(entry, ("deps", "params", "module"), name)
    module = entry.get("module", MODULES.get(name))
    if not isinstance(module, str):
        near = _hint(name, list(MODULES))
        raise ConfigError(f"{where}: stage {name!r} needs a `module`{near}")
    return StageEntry(
        name=name,
        module=module,
        deps=_words(entry, "deps"),
        params=_words(entry, "params"),
        where=where,
    )


def _profile(entry: Lined, sections: Sequence[str], environ: Mapping[str, str]) -> Overlay:
    settings = Lined(entry.file)
    for key, value in entry.items():
        if key != SOURCES:
            settings[key], settings.lines[key] = value, entry.lines[key]
    return Overlay(_sources(entry, environ), _values(settings, sections))


def _values(params: Lined, sections: Sequence[str]) -> dict[str, dict[str, Value]]:
    _known(params, sections, "params")
    return {
        section: {
            key: Value(value, f"{_inner(params, section).where(key)}: {section}")
            for key, value in _inner(params, section).items()
        }
        for section in params
    }


def _overrides(words: Sequence[str], sections: Sequence[str]) -> Overlay:
    values: dict[str, dict[str, Value]] = {}
    for word in words:
        match = re.fullmatch(r"([\w-]+)\.(\w+)=(.*)", word, re.DOTALL)
        if match is None:
            raise ConfigError(f"-s {word}: expected section.key=value, as train.steps=100")
        section, key, value = match.groups()
        if section not in sections:
            hint = _hint(section, sections)
            raise ConfigError(f"-s {word}: no section {section!r}{hint}")
        values.setdefault(section, {})[key] = Value(value, f"-s {section}")
    return Overlay((), values)


def _sources(entry: Lined, environ: Mapping[str, str]) -> tuple[str, ...]:
    given = entry.get(SOURCES)
    if given is None:
        return ()
    paths = [given] if isinstance(given, str) else given
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        raise ConfigError(f"{entry.where(SOURCES)}: expected a path or a list of paths")
    return tuple(_expand(path, environ, entry.where(SOURCES)) for path in paths)


def _expand(path: str, environ: Mapping[str, str], where: str) -> str:
    def value(match: re.Match[str]) -> str:
        name, default = match.groups()
        if environ.get(name):
            return environ[name]
        if default is None:
            way = f"set it, or write ${{{name}:-default}}"
            raise ConfigError(f"{where}: variable {name} is not set; {way}")
        return str(default)

    return re.sub(r"\$\{(\w+)(?::-([^}]*))?\}", value, path)


def _inner(mapping: Lined, key: str) -> Lined:
    found = mapping.get(key)
    if found is None:
        return Lined(mapping.file)
    if not isinstance(found, Lined):
        raise ConfigError(f"{mapping.where(key)}: {key} is {found!r}; expected a mapping")
    return found


def _words(mapping: Lined, key: str) -> tuple[str, ...]:
    found = mapping.get(key, [])
    if not isinstance(found, list) or not all(isinstance(word, str) for word in found):
        raise ConfigError(f"{mapping.where(key)}: {key} is {found!r}; expected a list")
    return tuple(found)


def _known(mapping: Lined, names: Sequence[str], what: str) -> None:
    for key in mapping:
        if key not in names:
            hint = _hint(key, names)
            raise ConfigError(f"{mapping.where(key)}: {what}: no entry {key!r}{hint}")


def _pick(found: Mapping[str, Overlay], name: str, what: str, where: str) -> Overlay:
    if name not in found:
        raise ConfigError(f"{where} {name}: no {what} {name!r}{_hint(name, list(found))}")
    return found[name]


def _hint(name: str, names: Sequence[str]) -> str:
    near = get_close_matches(name, names, n=1)
    if near:
        return f"; did you mean {near[0]!r}?"
    return f"; there is {', '.join(names)}" if names else ""
