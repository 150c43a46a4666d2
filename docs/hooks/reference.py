"""Writes into the site what the code says of itself, so that it cannot go out of date.

A page says where, by a comment on a line of its own:

- ``<!-- commands -->``: every verb of the command line with its options.
- ``<!-- settings -->``: every setting of every stage, with its default.
- ``<!-- fields: infgen.scene.Tracks -->``: the fields of a record.
"""

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from importlib import import_module
from typing import Any, get_type_hints

import typer

import cli
from pipeline.settings import DEFAULT_FILE, load_stages
from pipeline.stages import load_stage

_DIRECTIVE = re.compile(r"^<!-- (commands|settings|fields: \S+) -->$", re.MULTILINE)
_ATTRIBUTE = re.compile(r"^    (\w+(?:,\s+\w+)*): ((?:.|\n     )*)", re.MULTILINE)
"""One attribute of a docstring, or several that are told together."""


def on_page_markdown(markdown: str, **_: object) -> str:
    """Replace the comments of a page; called by the site's builder."""
    return _DIRECTIVE.sub(lambda match: _written(match[1]), markdown)


def _written(directive: str) -> str:
    if directive == "commands":
        return "\n".join(commands())
    if directive == "settings":
        return "\n".join(settings())
    module, _, name = directive.removeprefix("fields: ").rpartition(".")
    return "\n".join(record(getattr(import_module(module), name)))


def commands() -> Iterator[str]:
    """Write every verb: what it does, how it is called, its options."""
    group: Any = typer.main.get_command(cli.app)
    with group.make_context("infgen", [], resilient_parsing=True) as context:
        for name in group.list_commands(context):
            yield from _command(name, group.get_command(context, name))


def _command(name: str, command: Any) -> Iterator[str]:
    what, *examples = inspect.cleandoc(command.help).split("\n\n")
    yield f"## infgen {name}\n\n{_one_line(what)}\n"
    for example in examples:
        shown = example.removeprefix("Example: ")
        is_call = shown != example
        yield f"```text\n{_one_line(shown)}\n```\n" if is_call else f"{_one_line(shown)}\n"
    rows = [
        [_flags(parameter), _default(parameter), parameter.help or ""]
        for parameter in command.params
        if parameter.name != "help"
    ]
    yield from _table(["word", "default", "meaning"], rows)


def _flags(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{parameter.metavar or parameter.name.upper()}`"
    return " ".join(f"`{flag}`" for flag in (*parameter.opts, *parameter.secondary_opts))


def _default(parameter: Any) -> str:
    if parameter.required:
        return "must be given"
    off = parameter.default is None or parameter.default is False or parameter.default == ()
    return "" if off else f"`{parameter.default}`"


def settings() -> Iterator[str]:
    """Write every section of ``stages.yaml``, in the order of the stages."""
    file, written = load_stages(DEFAULT_FILE, {}), set()
    for entry in file.stages.values():
        for section, kind in load_stage(entry.module).settings.items():
            if section not in written:
                written.add(section)
                yield from _section(section, kind)


def _section(section: str, kind: type) -> Iterator[str]:
    about, described = documented(kind)
    yield f"## {section}\n\n{about}\n"
    rows = [
        [f"`{field.name}`", f"`{_given(field)}`", described.get(field.name, "")]
        for field in fields(kind)
    ]
    yield from _table(["setting", "default", "meaning"], rows)


def _given(field: "Field[Any]") -> str:
    if field.default_factory is not MISSING:
        return str(field.default_factory())
    return "" if field.default is MISSING else str(field.default)


def record(kind: type) -> Iterator[str]:
    """Write the fields of a record: type, shape, meaning."""
    hints, (_, described) = get_type_hints(kind, include_extras=True), documented(kind)
    rows = [
        [f"`{field.name}`", *_shape(hints[field.name]), described.get(field.name, "")]
        for field in fields(kind)
    ]
    yield from _table(["field", "type", "shape", "meaning"], rows)


def _shape(hint: Any) -> tuple[str, str]:
    """Type and shape of a field: an annotated array, another record or a plain value."""
    if hasattr(hint, "dim_str"):
        return hint.dtypes[0], f"[{', '.join(hint.dim_str.split())}]"
    return getattr(hint, "__name__", str(hint)), ""


def documented(kind: type) -> tuple[str, Mapping[str, str]]:
    """What a dataclass's docstring says of it, and of each of its attributes."""
    about, _, listed = inspect.cleandoc(kind.__doc__ or "").partition("\nAttributes:\n")
    texts = {
        name: _one_line(text)
        for names, text in _ATTRIBUTE.findall(listed)
        for name in re.split(r",\s+", names)
    }
    return _one_line(about), texts


def _one_line(text: str) -> str:
    plain = re.sub(r"\s*\(SPEC [^)]*\)", "", text)  # Which readers of the site do not have.
    return " ".join(plain.replace("``", "`").split())


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    if not rows:
        return
    yield f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}"
    for row in rows:
        yield f"| {' | '.join(cell.replace('|', '&#124;') for cell in row)} |"
    yield ""
