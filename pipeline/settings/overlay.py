"""Overlays: settings by section from ``stages.yaml`` or the command line.

Every value knows where it was given, so that errors name its line.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from infgen.errors import ConfigError
from pipeline.engine.layout import Root
from pipeline.engine.stage import Source
from pipeline.settings.lined_yaml import LinedMapping, did_you_mean, inner, known
from pipeline.storage.sources.source_files import find_sources


@dataclass(frozen=True, slots=True)
class SettingValue:
    """A value and the place where it was given."""

    value: Any
    where: str


@dataclass(frozen=True, slots=True)
class Overlay:
    """Settings by section, and source files; empty where none are given."""

    sources: tuple[str, ...]
    values: Mapping[str, Mapping[str, SettingValue]]

    def with_sources(self, sources: tuple[str, ...]) -> "Overlay":
        """Replace the source files."""
        return Overlay(sources, self.values)

    def build(self, section: str, kind: Any) -> Any:
        """Return the settings of a section, of the class that a stage names for it.

        Raises:
            ConfigError: for a setting that does not exist or cannot have its value.
        """
        from infgen.settings import build  # noqa: PLC0415  # Pydantic takes 0.1 s.

        given = self.values.get(section, {})
        values = {name: each.value for name, each in given.items()}
        return build(kind, values, {name: each.where for name, each in given.items()})

    def find_sources(self, root: Root) -> tuple[Source, ...]:
        """Find the source files and their identities.

        Raises:
            ConfigError: if there are none.
        """
        return find_sources(self.sources, root)

    @property
    def words(self) -> tuple[str, ...]:
        """Its settings as arguments of ``-s`` on the command line."""
        return tuple(
            f"{section}.{key}={_word(given.value)}"
            for section, settings in self.values.items()
            for key, given in settings.items()
        )


def merge_overlays(layers: Iterable[Overlay]) -> Overlay:
    """Merge overlays; later ones take precedence."""
    sources: tuple[str, ...] = ()
    values: dict[str, dict[str, SettingValue]] = {}
    for layer in layers:
        sources = layer.sources or sources
        for section, given in layer.values.items():
            values.setdefault(section, {}).update(given)
    return Overlay(sources, values)


def read_sections(params: LinedMapping, sections: Sequence[str]) -> Overlay:
    """Read settings by section from YAML; only their sections are checked.

    Raises:
        ConfigError: naming the line of what is not a section, or not a mapping.
    """
    known(params, sections, "params")
    values = {
        section: {
            key: SettingValue(value, f"{inner(params, section).where(key)}: {section}")
            for key, value in inner(params, section).items()
        }
        for section in params
    }
    return Overlay((), values)


def read_overrides(words: Sequence[str], sections: Sequence[str]) -> Overlay:
    """Read settings from ``section.key=value`` words of the command line.

    Raises:
        ConfigError: naming the word.
    """
    values: dict[str, dict[str, SettingValue]] = {}
    for word in words:
        match = re.fullmatch(r"([\w-]+)\.(\w+)=(.*)", word, re.DOTALL)
        if match is None:
            raise ConfigError(f"-s {word}: expected section.key=value, as train.steps=100")
        section, key, value = match.groups()
        if section not in sections:
            raise ConfigError(
                f"-s {word}: no section {section!r}{did_you_mean(section, sections)}"
            )
        values.setdefault(section, {})[key] = SettingValue(value, f"-s {section}")
    return Overlay((), values)


def _word(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
