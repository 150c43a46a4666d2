"""Every setting with its default and its help text, read from the settings classes."""

import re
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields
from typing import Any

from infgen.errors import ConfigError
from pipeline.engine.registry import load_stage
from pipeline.settings.lined_yaml import did_you_mean
from pipeline.settings.stages_file import StagesFile


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting.

    Attributes:
        name: With its section, as after ``-s``.
        default: Its value where nobody gives it one.
        meaning: What it is.
    """

    name: str
    default: Any
    meaning: str


@dataclass(frozen=True, slots=True)
class Section:
    """The settings that a stage reads under one name.

    Attributes:
        name: As in ``stages.yaml``.
        about: What they are about.
        settings: One after the other.
    """

    name: str
    about: str
    settings: tuple[Setting, ...]


def sections(file: StagesFile) -> Iterator[Section]:
    """Describe every section of a ``stages.yaml``, in the order of its stages."""
    listed = set()
    for entry in file.stages.values():
        for name, kind in load_stage(entry.module).settings.items():
            if name not in listed:
                listed.add(name)
                yield _section(name, kind)


def find_sections(file: StagesFile, named: str | None) -> list[Section]:
    """Describe the settings that are named; all without a name.

    Args:
        file: Of the stages.
        named: A section, or one of its settings with it: ``train.steps``.

    Raises:
        ConfigError: if there is no such section or setting.
    """
    found = list(sections(file))
    if named is None:
        return found
    name, _, setting = named.partition(".")
    by_name = {section.name: section for section in found}
    if name not in by_name:
        raise ConfigError(
            f"no section {name!r} of settings{did_you_mean(name, list(by_name))}"
        )
    if not setting:
        return [by_name[name]]
    wanted = [each for each in by_name[name].settings if each.name == named]
    if not wanted:
        there = did_you_mean(
            setting, [each.name.split(".")[1] for each in by_name[name].settings]
        )
        raise ConfigError(f"{name}: no setting {setting!r}{there}")
    return [Section(name, by_name[name].about, tuple(wanted))]


def _section(name: str, kind: Any) -> Section:
    from infgen.settings import help_texts  # noqa: PLC0415  # Pydantic takes 0.1 s.

    texts = help_texts(kind)
    settings = [
        Setting(
            f"{name}.{field.name}",
            "" if field.default is MISSING else field.default,
            one_line(texts.get(field.name, "")),
        )
        for field in fields(kind)
    ]
    return Section(name, one_line(kind.__doc__ or ""), tuple(settings))


def one_line(text: str) -> str:
    """Write a docstring in one line, without references to the specification."""
    plain = re.sub(r"\s*\(SPEC [^)]*\)", "", text)
    return " ".join(plain.replace("``", "`").split())
