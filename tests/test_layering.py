"""Data flows one way, so imports do too."""

import ast
from collections import Counter
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


@pytest.fixture(scope="module", params=FILES, ids=named)
def file(request):
    return request.param


@pytest.fixture(scope="module")
def tree(file):
    return ast.parse(file.read_text())


def test_a_file_keeps_to_its_room(file, tree):
    used = packages(ast.walk(tree))

    if file.is_relative_to(INFGEN) and file not in DOORS_TO_PIPELINE:
        assert not used & {"pipeline", "cli"}
        assert "polars" not in used or named(file) == TABLES
    if file.parent in NUMPY_ONLY:
        assert "torch" not in used


def test_imports_keep_the_contracts_of_pyproject_and_have_no_cycle(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)

    broken = import_linter.lint_imports(no_cache=True)

    assert not broken, capsys.readouterr().out


def test_a_folder_has_about_twenty_modules_at_most():
    folders = Counter(path.parent for path in FILES if path.name != "__init__.py")

    assert {named(folder): n for folder, n in folders.items() if n > MOST_MODULES} == {}


def test_a_package_is_imported_only_through_its_door(file, tree):
    for package in packages(ast.walk(tree)) & DOORS.keys():
        assert named(file) in DOORS[package], f"{package} belongs to {DOORS[package]}"


def test_nothing_unsafe_is_called(file, tree):
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    names = {call.func.id for call in calls if isinstance(call.func, ast.Name)}
    whole = {ast.unparse(call.func) for call in calls}

    assert not names & UNSAFE
    assert not whole & {"yaml.load", "torch.load", "os.system"}
    for call in calls:
        assert not any(keyword.arg == "shell" for keyword in call.keywords)


def test_a_file_and_its_functions_are_short(file, tree):
    assert len(file.read_text().splitlines()) <= LONGEST_FILE
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            code = node.body[1:] if ast.get_docstring(node) else node.body
            length = node.end_lineno - code[0].lineno if code else 0
            assert length < LONGEST_FUNCTION, node.name


def test_a_name_says_what_is_in_a_file(file):
    assert not {part.removesuffix(".py") for part in file.relative_to(ROOT).parts} & VAGUE


def test_the_environment_is_read_by_the_command_line_only(file, tree):
    reads = {
        ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)
    }

    if file.name not in ("cli.py", "options.py", "verbs.py"):
        assert not reads & {"os.environ", "os.getenv"}


@pytest.mark.parametrize("module", MODULES.values())
def test_a_stage_module_is_light_to_import(module):
    path = ROOT / f"{module.replace('.', '/')}.py"

    assert not packages(at_import(ast.parse(path.read_text()))) & HEAVY
