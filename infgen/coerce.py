"""Plain values, as YAML or the command line gave them, to settings of the right types."""

import math
import types
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import field, fields
from difflib import get_close_matches
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


class ConfigError(ValueError):
    """A setting that does not exist or cannot have that value."""


def free(default: T) -> T:
    """Default of a setting that decides how work is done, and nothing of what comes out.

    Keys leave it out: what was made with another value is not made again.
    """
    made: T = field(default=default, metadata={"free": True})
    return made


def key_values(settings: Any) -> dict[str, Any]:
    """Settings that decide what comes out, by name: all but the ``free`` ones."""
    return {
        f.name: getattr(settings, f.name)
        for f in fields(settings)
        if not f.metadata.get("free")
    }


def build(kind: type[T], values: Mapping[str, Any], where: str) -> T:
    """Make settings from plain values. A key that is not a field is an error.

    Args:
        kind: The settings' dataclass.
        values: Field names to values, as YAML or the command line gave them.
        where: What to call the place in messages (``stages.yaml:12: train``).

    Raises:
        ConfigError: naming the key, where it stands, and the nearest real one; or the value
            and the type expected.
    """
    return kind(**{key: settle(kind, key, value, where) for key, value in values.items()})


def settle(kind: type, key: str, value: Any, where: str) -> Any:
    """Check one setting and give its value the type of its field.

    Raises:
        ConfigError: as ``build`` does.
    """
    names = [field.name for field in fields(kind)]
    if key not in names:
        near = get_close_matches(key, names, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"there is {', '.join(names)}"
        raise ConfigError(f"{where}: no setting {key!r}; {hint}")
    return coerce(value, get_type_hints(kind)[key], f"{where}.{key}")


def coerce(value: Any, kind: Any, where: str) -> Any:
    """Give a plain value the type of its field.

    A YAML ``5e-4`` arrives as a string and becomes a float; a float is never cut to an int,
    and an int keeps all its digits. No setting is infinite or not a number.

    Raises:
        ConfigError: naming the place, the value and the type expected.
    """
    if get_origin(kind) in (Union, types.UnionType):
        if value is None:
            return None
        kind = next(k for k in get_args(kind) if k is not type(None))
    wrong = ConfigError(f"{where} is {value!r}; expected {getattr(kind, '__name__', kind)}")
    if kind is str and isinstance(value, bool):
        return str(value).lower()  # YAML's ``true`` where ``auto`` may stand too.
    if kind is bool:
        if str(value).lower() not in ("true", "false"):
            raise wrong
        return str(value).lower() == "true"
    if isinstance(value, bool) or value is None:
        raise wrong
    if kind is str:
        return str(value)
    try:
        return _whole(value) if kind is int else _finite(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise wrong from error


def _whole(value: Any) -> int:
    """Make an int: of ``1e3`` too, but not of ``1.5``."""
    if isinstance(value, int):
        return int(value)
    with suppress(ValueError):  # Through a float, long ones would lose digits.
        return int(str(value))
    number = float(value)
    if number != int(number):
        raise ValueError("not whole")
    return int(number)


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError("not finite")
    return number


def check_bounds(
    settings: Any, stage: str, bounds: Iterable[tuple[str, int | float, int | float]]
) -> None:
    """Refuse numbers that are out of bounds.

    Args:
        settings: A settings' dataclass.
        stage: What the settings are of, for the message.
        bounds: Field, least and greatest value, infinity for none.

    Raises:
        ConfigError: naming the setting, its value and what was expected.
    """
    for name, least, most in bounds:
        value = getattr(settings, name)
        if not least <= value <= most:
            rest = "or more" if most == math.inf else f"to {_told(most)}"
            raise ConfigError(f"{stage}.{name} is {value}; expected {_told(least)} {rest}")


def check_numbers(
    settings: Any, stage: str, bounds: Mapping[str, tuple[int | float, int | float]]
) -> None:
    """Refuse numbers that are out of bounds, and negative ones of all other fields.

    Args:
        settings: A settings' dataclass.
        stage: What the settings are of, for the message.
        bounds: Least and greatest value by field, infinity for none.

    Raises:
        ConfigError: naming the setting, its value and what was expected.
    """
    numbers = [f.name for f in fields(settings) if f.type in (int, float)]
    every = {**dict.fromkeys(numbers, (0, math.inf)), **bounds}
    check_bounds(settings, stage, ((name, *each) for name, each in every.items()))


def _told(bound: int | float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"
