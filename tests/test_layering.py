"""Data flows one way, so imports do too."""

import ast
from collections import Counter
from functools import cache
from pathlib import Path

import pytest
from importlinter import cli as import_linter

from pipeline.engine.registry import MODULES

ROOT = Path(__file__).parents[1]
FILES = sorted(
    [ROOT / "cli.py", *ROOT.glob("infgen/**/*.py"), *ROOT.glob("pipeline/**/*.py")]
)
INFGEN = ROOT / "infgen"
DOORS_TO_PIPELINE = {INFGEN / "__main__.py", INFGEN / "__init__.py"}
"""What reaches the pipeline by name: the command line, and the facade when it is used."""
DOORS = {
    "zarr": {"pipeline/storage/zarr_store.py"},
    "numcodecs": set(),
    "dask": {"pipeline/workers/dask_cluster.py"},
    "distributed": {"pipeline/workers/dask_cluster.py"},
    "rich": {"pipeline/commands/screen.py"},
    "typer": {
        "cli.py",
        "pipeline/commands/options.py",
        "pipeline/commands/tools.py",
        "pipeline/commands/verbs.py",
    },
    "yaml": {"pipeline/settings/lined_yaml.py"},
    "cli": {"infgen/__main__.py"},
    "pickle": {"infgen/sources/scenarionet/pickles.py"},  # Runs nothing: see there.
    "joblib": set(),
    "tensorflow": set(),
    "torch_geometric": set(),
}
"""Packages that only these files may import."""
TABLES = "infgen/sources/argoverse2/tables.py"
"""The one file of ``infgen`` that reads tables."""
HEAVY = {"torch", "zarr", "dask", "distributed", "polars", "matplotlib", "fsspec"}
"""Packages that stage modules import within functions only."""
NUMPY_ONLY = [INFGEN, INFGEN / "tokens"]  # These folders, not what is below them.
UNSAFE = {"eval", "exec", "__import__"}
VAGUE = {"utils", "util", "helpers", "common", "misc", "core", "base"}
LONGEST_FILE = 400
MOST_MODULES = 20
LONGEST_FUNCTION = 60


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


def packages(nodes) -> set[str]:
    """Top-level packages that some statements import, also by name at run time."""
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
        elif isinstance(node, ast.Call) and call_name(node) == "import_module":
            found |= {arg.value for arg in node.args if isinstance(arg, ast.Constant)}
    return {name.split(".")[0] for name in found}


def call_name(call: ast.Call) -> str:
    called = call.func
    return called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")


def at_import(tree: ast.AST):
    """What runs when a module is imported: nothing in functions or for types only."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        yield node
        yield from at_import(node)


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def found_in_files(found) -> dict[str, object]:
    """What ``found(path, tree)`` returns, by file, where it is anything."""
    every = {named(path): found(path, parsed(path)) for path in FILES}
    return {name: each for name, each in every.items() if each}


def out_of_its_room(path: Path, tree: ast.AST) -> set[str]:
    used = packages(ast.walk(tree))
    barred = set()
    if path.is_relative_to(INFGEN) and path not in DOORS_TO_PIPELINE:
        barred |= {"pipeline", "cli"}
        barred |= set() if named(path) == TABLES else {"polars"}
    if path.parent in NUMPY_ONLY:
        barred |= {"torch"}
    return used & barred


def not_through_its_door(path: Path, tree: ast.AST) -> dict[str, set[str]]:
    used = packages(ast.walk(tree)) & DOORS.keys()
    return {name: DOORS[name] for name in used if named(path) not in DOORS[name]}


def unsafe_calls(path: Path, tree: ast.AST) -> set[str]:
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    whole = {ast.unparse(call.func) for call in calls}
    shell = {
        "shell" for call in calls if any(word.arg == "shell" for word in call.keywords)
    }
    return whole & (UNSAFE | {"yaml.load", "torch.load", "os.system"}) | shell


def long_functions(path: Path, tree: ast.AST) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            code = node.body[1:] if ast.get_docstring(node) else node.body
            length = node.end_lineno - code[0].lineno if code else 0
            found |= {node.name} if length >= LONGEST_FUNCTION else set()
    return found


def reads_of_the_environment(path: Path, tree: ast.AST) -> set[str]:
    if path.name in ("cli.py", "options.py", "verbs.py"):
        return set()
    reads = {
        ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)
    }
    return reads & {"os.environ", "os.getenv"}


@pytest.mark.parametrize(
    "rule",
    [
        out_of_its_room,
        not_through_its_door,
        unsafe_calls,
        long_functions,
        reads_of_the_environment,
    ],
)
def test_all_files_keep_a_rule(rule):
    assert found_in_files(rule) == {}


@pytest.mark.parametrize(
    ("rule", "path", "code", "found"),
    [
        (out_of_its_room, "infgen/model/x.py", "import pipeline.engine", {"pipeline"}),
        (out_of_its_room, "infgen/tokens/x.py", "from torch import nn", {"torch"}),
        (out_of_its_room, "pipeline/x.py", "import polars, torch", set()),
        (unsafe_calls, "cli.py", "subprocess.run('ls', shell=True)", {"shell"}),
        (unsafe_calls, "cli.py", "torch.load(x), eval(x)", {"torch.load", "eval"}),
        (reads_of_the_environment, "infgen/x.py", "os.environ['A']", {"os.environ"}),
        (reads_of_the_environment, "cli.py", "os.environ['A']", set()),
        (long_functions, "x.py", "def f():\n" + "    x\n" * 61, {"f"}),
        (long_functions, "x.py", "def f():\n" + "    x\n" * 60, set()),
    ],
)
def test_a_rule_finds_what_breaks_it(rule, path, code, found):
    assert rule(ROOT / path, ast.parse(code)) == found


def test_a_package_is_imported_only_through_its_door():
    tree = ast.parse("import_module('zarr')")

    assert not not_through_its_door(ROOT / "pipeline/storage/zarr_store.py", tree)
    assert not_through_its_door(ROOT / "cli.py", tree) == {"zarr": DOORS["zarr"]}


def test_files_are_short():
    lines = {named(path): len(path.read_text().splitlines()) for path in FILES}

    assert {name: n for name, n in lines.items() if n > LONGEST_FILE} == {}


def test_names_say_what_is_in_a_file():
    parts = {
        named(path): {part.removesuffix(".py") for part in path.relative_to(ROOT).parts}
        for path in FILES
    }

    assert {name: each & VAGUE for name, each in parts.items() if each & VAGUE} == {}


def test_imports_keep_the_contracts_of_pyproject_and_have_no_cycle(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)

    broken = import_linter.lint_imports(no_cache=True)

    assert not broken, capsys.readouterr().out


def test_a_folder_has_about_twenty_modules_at_most():
    folders = Counter(path.parent for path in FILES if path.name != "__init__.py")

    assert {named(folder): n for folder, n in folders.items() if n > MOST_MODULES} == {}


@pytest.mark.parametrize("module", MODULES.values())
def test_a_stage_module_is_light_to_import(module):
    path = ROOT / f"{module.replace('.', '/')}.py"

    assert not packages(at_import(ast.parse(path.read_text()))) & HEAVY
