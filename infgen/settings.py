"""What every settings class is made with: types, bounds, and errors that name the place.

A room's settings are a frozen pydantic dataclass in its ``settings.py``; ``infgen.config``
gathers them all. The string below a field is its help text (``infgen settings``).
"""

import ast
import inspect
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields
from difflib import get_close_matches
from itertools import pairwise
from typing import Annotated, Any, Final, TypeVar

from pydantic import BeforeValidator, ConfigDict, Field, ValidationError

from infgen.errors import ConfigError
from infgen.renamed_settings import RENAMED

T = TypeVar("T")

RULES = ConfigDict(
    extra="forbid",
    allow_inf_nan=False,
    coerce_numbers_to_str=True,
    defer_build=True,  # Most commands build a few sections only.
)
"""How all settings are read."""
_UNKNOWN = "unexpected_keyword_argument"
MAX_SEED = 2**63 - 1


class _NotInKey:
    """Marks a setting that changes how work is done, and nothing of what comes out."""


NOT_IN_KEY: Final = _NotInKey()
"""In a field's annotation: what was made with another value is not made again."""


def _whole(value: Any) -> Any:
    """Read ``1e3`` as an int, and long ints without losing digits through a float."""
    _refuse_bool(value)
    for read in (int, float) if isinstance(value, str) else ():
        with suppress(ValueError):
            return read(value)
    return value


def _refuse_bool(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("expected a number")
    return value


def _switch(value: Any) -> Any:
    """Read true and false only: not 0, 1, yes or no."""
    if str(value).lower() not in ("true", "false"):
        raise ValueError("expected true or false")
    return str(value).lower() == "true"


def _word(value: Any) -> Any:
    """Read YAML's ``true`` where a word such as ``auto`` may stand too."""
    return str(value).lower() if isinstance(value, bool) else value


Int = Annotated[int, BeforeValidator(_whole)]
Float = Annotated[float, BeforeValidator(_refuse_bool)]
Bool = Annotated[bool, BeforeValidator(_switch)]
Text = BeforeValidator(_word)
Count = Annotated[Int, Field(ge=0)]
AtLeastOne = Annotated[Int, Field(ge=1)]
NonNegative = Annotated[Float, Field(ge=0)]
Positive = Annotated[Float, Field(gt=0)]
Share = Annotated[Float, Field(ge=0, le=1)]
Nucleus = Annotated[Float, Field(gt=0, le=1)]
Seed = Annotated[Int, Field(ge=0, le=MAX_SEED)]


def build(kind: type[T], values: Mapping[str, Any], where: str | Mapping[str, str]) -> T:
    """Make settings from plain values, as YAML or the command line gave them.

    Args:
        kind: A pydantic dataclass with ``RULES``.
        values: Values by field name.
        where: What to call the place in messages (``stages.yaml:12: train``), or that of
            each value.

    Raises:
        ConfigError: naming the place and the nearest real setting; or the value and what
            was expected.
    """
    try:
        return kind(**values)
    except ValidationError as error:
        raise _config_error(error, kind, values, where) from error


def _config_error(
    error: ValidationError,
    kind: type,
    values: Mapping[str, Any],
    where: str | Mapping[str, str],
) -> ConfigError:
    """Tell the first thing that is wrong in one line, with its place."""
    unknown = [each for each in error.errors() if each["type"] == _UNKNOWN]
    first = (unknown or error.errors())[0]
    missing = [] if unknown else _missing(error)
    said = _said(first["msg"])
    key = str(first["loc"][0]) if first["loc"] else ""
    place = where if isinstance(where, str) else _place(key, said, where)
    if not key:
        return ConfigError(f"{place}: {said}")
    if missing:
        return ConfigError(f"{place}: {', '.join(missing)} missing")
    if unknown:
        return ConfigError(f"{place}: no setting {key!r}; {_nearest(key, kind)}")
    return ConfigError(f"{place}.{key} is {values[key]!r}; {said}")


def _said(message: str) -> str:
    """Shorten a message of pydantic to what was expected."""
    said = message.removeprefix("Value error, ").replace("Input should be", "expected")
    for long, short in (("a valid integer", "int"), ("a valid number", "float")):
        said = said.replace(long, short)
    return said.split(", unable to parse")[0]


def _missing(error: ValidationError) -> list[str]:
    return [str(each["loc"][0]) for each in error.errors() if each["type"] == "missing"]


def _place(key: str, said: str, where: Mapping[str, str]) -> str:
    """Find the place of a value, or of one that a message about several names."""
    if key in where:
        return where[key]
    named = (place for name, place in where.items() if name in said)
    return next(named, next(iter(where.values()), ""))


def _nearest(key: str, kind: type) -> str:
    names = [field.name for field in fields(kind)]
    if RENAMED.get(key) in names:
        return f"it is now {RENAMED[key]!r}"
    near = get_close_matches(key, names, n=1)
    return f"did you mean {near[0]!r}?" if near else f"there is {', '.join(names)}"


def key_values(settings: Any) -> dict[str, Any]:
    """Return the settings that decide what comes out, by name."""
    return {
        name: getattr(settings, name)
        for name, field in type(settings).__pydantic_fields__.items()
        if NOT_IN_KEY not in field.metadata
    }


def help_texts(kind: type) -> dict[str, str]:
    """Return the string below each field of a settings class, by name."""
    (definition,) = ast.parse(inspect.getsource(kind)).body
    body = definition.body if isinstance(definition, ast.ClassDef) else []
    return {
        field.target.id: inspect.cleandoc(text.value.value)
        for field, text in pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }
