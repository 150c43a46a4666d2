"""Hash of the code that decides the bytes of an artefact.

Hashed are the modules that a stage names and all modules of ``infgen`` that these import,
directly or not. Modules of settings are left out: settings are in every key by value.
"""

import ast
import hashlib
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from pipeline.engine.atomic import StoreError

LIBRARY = "infgen"
SETTINGS = ("settings", "config")
"""Endings of the names of settings modules."""


def code_hash(modules: Sequence[str]) -> str:
    """Hash the source of modules and what they import, without importing them.

    Args:
        modules: Modules, or packages for all files in them.

    Raises:
        StoreError: if one of them has no source.
    """
    return _code_hash(tuple(sorted(modules)))


def imported_modules(modules: Iterable[str]) -> dict[str, Path]:
    """Find the files of modules, and of all that they import of the library.

    Raises:
        StoreError: if one of the modules has no source.
    """
    found: dict[str, Path] = {}
    left = [pair for name in modules for pair in _files(name)]
    while left:
        name, path = left.pop()
        if name in found:
            continue
        found[name] = path
        left += [
            (other, place)
            for other in _imports(path)
            if (place := _file(other)) is not None
        ]
    return found


@cache
def _code_hash(modules: tuple[str, ...]) -> str:
    digest = hashlib.sha256()
    for name, path in sorted(imported_modules(modules).items()):
        source = path.read_bytes()
        digest.update(f"{name}\0{len(source)}\0".encode() + source)
    return digest.hexdigest()


@cache
def _imports(path: Path) -> frozenset[str]:
    """Names that may be modules of the library: those imported, and packages above them."""
    named: set[str] = set()
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            named |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            named |= {node.module, *(f"{node.module}.{one.name}" for one in node.names)}
    parts = [name.split(".") for name in named if name.split(".")[0] == LIBRARY]
    every = {".".join(some[:upto]) for some in parts for upto in range(1, len(some) + 1)}
    return frozenset(name for name in every if not name.endswith(SETTINGS))


def _files(module: str) -> Iterator[tuple[str, Path]]:
    """Files of a module that is named; of a package, all of them."""
    place = _place(module)
    paths = sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]
    if not paths or not all(path.is_file() for path in paths):
        raise StoreError(f"module {module} has no source at {place}")
    for path in paths:
        inner = path.relative_to(place).with_suffix("") if place.is_dir() else Path()
        parts = [part for part in inner.parts if part != "__init__"]
        yield ".".join([module, *parts]), path


@cache
def _file(module: str) -> Path | None:
    """The file that an import of this name runs; None if it is no module."""
    place = _place(module)
    paths = (place.with_suffix(".py"), place / "__init__.py")
    return next((path for path in paths if path.is_file()), None)


@cache
def _place(module: str) -> Path:
    top, *rest = module.split(".")
    spec = find_spec(top)
    if spec is None:
        raise StoreError(f"module {module} has no source")
    folders = list(spec.submodule_search_locations or ())
    package = Path(folders[0]) if folders else Path(spec.origin or "").with_suffix("")
    return package.joinpath(*rest)
