"""YAML mappings that know the line of every key and refuse a repeated key."""

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml

from infgen.errors import ConfigError

MAPPING = yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG
SEQUENCE = yaml.resolver.BaseResolver.DEFAULT_SEQUENCE_TAG
RENAMED_ENTRIES = {
    "plays": "rollout_sets",
    "start": "starts_from",
    "no-leave-token": "no-remove-token",
    "no-cell-token": "no-position-token",
}
"""Names that entries and profiles had before, told where one is given."""


class LinedMapping(dict[str, Any]):
    """A mapping read from YAML.

    Attributes:
        file: Name of its file.
        lines: Line of each key, from 1.
    """

    def __init__(self, file: str) -> None:
        super().__init__()
        self.file = file
        self.lines: dict[str, int] = {}

    def where(self, key: str) -> str:
        """Place of a key, as ``stages.yaml:12``."""
        return f"{self.file}:{self.lines[key]}"


def load(path: Path) -> LinedMapping:
    """Read a YAML file whose outermost value is a mapping.

    Raises:
        ConfigError: naming file and line, if it is not YAML, or a key is given twice.
    """
    try:
        node = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except FileNotFoundError as error:
        way = "`infgen init` writes a stages.yaml"
        raise ConfigError(f"{path} is missing; {way}") from error
    except IsADirectoryError as error:
        raise ConfigError(f"{path} is a folder; expected a YAML file") from error
    except UnicodeDecodeError as error:
        where = f"byte {error.object[error.start]:#04x} at {error.start}"
        raise ConfigError(f"{path} is no text ({where}); expected a YAML file") from error
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: {' '.join(str(error).split())}") from error
    loaded = _plain(node, path.name) if node is not None else LinedMapping(path.name)
    if not isinstance(loaded, LinedMapping):
        raise ConfigError(f"{path}: expected a mapping, got {type(loaded).__name__}")
    return loaded


def inner(mapping: LinedMapping, key: str) -> LinedMapping:
    """Return the mapping under a key; an empty one if there is none.

    Raises:
        ConfigError: if it is something else.
    """
    found = mapping.get(key)
    if found is None:
        return LinedMapping(mapping.file)
    if not isinstance(found, LinedMapping):
        raise ConfigError(f"{mapping.where(key)}: {key} is {found!r}; expected a mapping")
    return found


def words(mapping: LinedMapping, key: str) -> tuple[str, ...]:
    """Return the list of words under a key; none if there is no such key.

    Raises:
        ConfigError: if it is something else.
    """
    found = mapping.get(key, [])
    if not isinstance(found, list) or not all(isinstance(word, str) for word in found):
        raise ConfigError(f"{mapping.where(key)}: {key} is {found!r}; expected a list")
    return tuple(found)


def known(mapping: LinedMapping, names: Sequence[str], what: str) -> None:
    """Refuse keys that are not among some names.

    Raises:
        ConfigError: naming the first such key, and the nearest name.
    """
    for key in mapping:
        if key not in names:
            raise ConfigError(
                f"{mapping.where(key)}: {what}: no entry {key!r}{did_you_mean(key, names)}"
            )


def did_you_mean(name: str, names: Sequence[str]) -> str:
    """Return the ending of a message that names what may have been meant."""
    if (new := RENAMED_ENTRIES.get(name)) in names:
        return f"; it is now {new!r}"
    near = get_close_matches(name, names, n=1)
    if near:
        return f"; did you mean {near[0]!r}?"
    return f"; there is {', '.join(names)}" if names else ""


def _plain(node: yaml.Node, file: str) -> Any:
    if isinstance(node, yaml.MappingNode) and node.tag == MAPPING:
        return _mapping(node, file)
    if isinstance(node, yaml.SequenceNode) and node.tag == SEQUENCE:
        return [_plain(part, file) for part in node.value]
    try:
        return yaml.constructor.SafeConstructor().construct_object(node)
    except (yaml.YAMLError, ValueError) as error:
        said = " ".join(str(error).split())
        raise ConfigError(f"{file}:{_line(node)}: {said}") from error


def _mapping(node: yaml.MappingNode, file: str) -> LinedMapping:
    found = LinedMapping(file)
    for key_node, value_node in node.value:
        key = str(key_node.value)
        if key in found:
            raise ConfigError(
                f"{file}:{_line(key_node)}: {key!r} is given twice, first in line "
                f"{found.lines[key]}; keep one"
            )
        found.lines[key] = _line(key_node)
        found[key] = _plain(value_node, file)
    return found


def _line(node: yaml.Node) -> int:
    return int(node.start_mark.line) + 1
