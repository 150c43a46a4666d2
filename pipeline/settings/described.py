"""What the code says of its settings: name, default and meaning of each.

Read from the dataclasses and their docstrings, so that it cannot go out of date.
"""

import inspect
import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields
from typing import Any

from infgen.errors import ConfigError
from pipeline.engine.registry import load_stage
from pipeline.settings.lined_yaml import did_you_mean
from pipeline.settings.stages_file import StagesFile

_ATTRIBUTE = re.compile(r"^    (\w+(?:,\s+\w+)*): ((?:.|\n     )*)", re.MULTILINE)
"""One attribute of a docstring, or several that are told together."""


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
    told = set()
    for entry in file.stages.values():
        for name, kind in load_stage(entry.module).settings.items():
            if name not in told:
                told.add(name)
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
    about, meanings = docstring_parts(kind)
    settings = [
        Setting(f"{name}.{field.name}", _default(field), meanings.get(field.name, ""))
        for field in fields(kind)
    ]
    return Section(name, about, tuple(settings))


def _default(field: "Field[Any]") -> Any:
    if field.default_factory is not MISSING:
        return field.default_factory()
    return "" if field.default is MISSING else field.default


def docstring_parts(kind: type) -> tuple[str, Mapping[str, str]]:
    """What a dataclass's docstring says of it, and of each of its attributes."""
    about, _, listed = inspect.cleandoc(kind.__doc__ or "").partition("\nAttributes:\n")
    texts = {
        name: one_line(text)
        for names, text in _ATTRIBUTE.findall(listed)
        for name in re.split(r",\s+", names)
    }
    return one_line(about), texts


def one_line(text: str) -> str:
    """Write a text of the code for readers who have neither it nor its specification."""
    plain = re.sub(r"\s*\(SPEC [^)]*\)", "", text)
    return " ".join(plain.replace("``", "`").split())
