"""Writes into the site what the code says of itself, so that it cannot go out of date.

A page says where, by a comment on a line of its own:

- ``<!-- commands -->``: every verb of the command line with its options.
- ``<!-- settings -->``: every setting of every stage, with its default.
- ``<!-- fields: infgen.scene.Tracks -->``: the fields of a record.
- ``<!-- model card -->``: the card of the weights that come with the package.
"""

import inspect
import re
from collections.abc import Iterator, Sequence
from dataclasses import fields
from importlib import import_module
from typing import Any, get_type_hints

import typer

import cli
from infgen.pretrained.card import builtin_card
from pipeline.settings.described import one_line, sections
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages

_DIRECTIVE = re.compile(
    r"^<!-- (commands|settings|model card|fields: \S+) -->$", re.MULTILINE
)
_ATTRIBUTE = re.compile(r"^    (\w+(?:,\s+\w+)*): ((?:.|\n     )*)", re.MULTILINE)
"""One attribute of a docstring, or several that are described together."""


def on_page_markdown(markdown: str, **_: object) -> str:
    """Replace the comments of a page; called by the site's builder."""
    return _DIRECTIVE.sub(lambda match: _written(match[1]), markdown)


def _written(directive: str) -> str:
    if directive == "commands":
        return "\n".join(commands())
    if directive == "settings":
        return "\n".join(settings())
    if directive == "model card":
        return builtin_card().partition("\n")[2]
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
    yield f"## infgen {name}\n\n{one_line(what)}\n"
    for example in examples:
        shown = example.removeprefix("Example: ")
        is_call = shown != example
        yield f"```text\n{one_line(shown)}\n```\n" if is_call else f"{one_line(shown)}\n"
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
    for section in sections(load_stages(DEFAULT_FILE, {})):
        yield f"## {section.name}\n\n{section.about}\n"
        rows = [
            [f"`{each.name.split('.')[1]}`", f"`{each.default}`", each.meaning]
            for each in section.settings
        ]
        yield from _table(["setting", "default", "meaning"], rows)


def record(kind: type) -> Iterator[str]:
    """Write the fields of a record: type, shape, meaning."""
    hints, described = get_type_hints(kind, include_extras=True), attributes(kind)
    rows = [
        [f"`{field.name}`", *_shape(hints[field.name]), described.get(field.name, "")]
        for field in fields(kind)
    ]
    yield from _table(["field", "type", "shape", "meaning"], rows)


def attributes(kind: type) -> dict[str, str]:
    """Read what a record's docstring says of each of its attributes."""
    listed = inspect.cleandoc(kind.__doc__ or "").partition("\nAttributes:\n")[2]
    return {
        name: one_line(text)
        for names, text in _ATTRIBUTE.findall(listed)
        for name in re.split(r",\s+", names)
    }


def _shape(hint: Any) -> tuple[str, str]:
    """Type and shape of a field: an annotated array, another record or a plain value."""
    if hasattr(hint, "dim_str"):
        return hint.dtypes[0], f"[{', '.join(hint.dim_str.split())}]"
    return getattr(hint, "__name__", str(hint)), ""


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    if not rows:
        return
    yield f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}"
    for row in rows:
        yield f"| {' | '.join(cell.replace('|', '&#124;') for cell in row)} |"
    yield ""
