"""Imports of the package: no circle between its modules, lazy imports included, and imports by
string only where a name is data.
"""

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = "wasp_cli"

BY_STRING = frozenset(
    {
        "import_here",
        "load_target",
        "import_module",
        "__import__",
        "entry_points",
        "find_spec",
        "module_from_spec",
        "run_module",
        "run_path",
        "exec_module",
        "resolve_name",
        "iter_modules",
        "walk_packages",
    }
)
"""Calls that import, or look for, a module whose name is a value."""
RUNS_TEXT = frozenset({"exec", "eval", "compile"})
ALLOWED: Mapping[str, str] = {
    "registry.py": "the one place that imports what registries and plugins name",
    "own.py": "whether a module is one of Python's tests, without importing it",
    "methods/registry.py": "the config model that a method's registry entry "
    "names: its section of the spec",
    "plan/grid.py": "the stage that a node's registry entry names",
    "run/verify.py": "the stage that evaluates cells, in the process that runs it",
    "run/worker.py": "the stage that a node names, in the process that runs it",
    "run/pools/choice.py": "whether dask or submitit is installed, without importing it",
    "learning/configs/__init__.py": "the file of a section that is asked for, so that "
    "a stage's closure has its own group "
    "alone",
    "plan/source.py": "where the source of a package lies, without importing it",
    "cli/completion.py": "the registry whose names are offered, imported when it is asked for",
    "cli/options.py": "whether the packages of an extra are installed",
    "cli/doctor.py": "whether each library imports is what the command reports",
    "tasks/foreign/assets.py": "where the module of an environment lies, without importing it",
    "tasks/foreign/lookup.py": "a spec may name a gymnasium environment of a "
    "package that nobody has imported",
    "tasks/foreign/translated.py": "a function of somebody else's that a spec names: what costs, "
    "and what is a success",
}
"""Files that import by string, and why the name has to be a value there."""


@cache
def sources(package: Path = ROOT / PACKAGE) -> dict[str, tuple[Path, ast.Module]]:
    """Path and tree of every module, by dotted name."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = path, ast.parse(path.read_text(encoding="utf-8"))
    return found


def statements(tree: ast.Module, typing: bool) -> Iterator[ast.AST]:
    """Every statement; without `typing` those that may run: all but those below `if
    TYPE_CHECKING`.
    """
    pending: list[ast.AST] = [tree]
    while pending:
        node = pending.pop()
        yield node
        if (
            not typing
            and isinstance(node, ast.If)
            and isinstance(node.test, ast.Name)
            and node.test.id == "TYPE_CHECKING"
        ):
            pending.extend(node.orelse)
        else:
            pending.extend(
                part for part in ast.iter_child_nodes(node) if not isinstance(part, ast.expr)
            )


def imports(
    name: str, path: Path, tree: ast.Module, known: Mapping[str, object], typing: bool
) -> set[str]:
    """The modules among `known` that a module imports anywhere, functions included."""
    found = set()
    for node in statements(tree, typing):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
            above = parts[: len(parts) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            # `from package import module` and `from module import name` look alike.
            modules = {f"{base}.{alias.name}" for alias in node.names} & set(known)
            found |= modules or {base}
    return (found & set(known)) - {name}


def graph(package: Path = ROOT / PACKAGE, typing: bool = False) -> dict[str, set[str]]:
    """What each module imports."""
    modules = sources(package)
    return {
        name: imports(name, path, tree, modules, typing) for name, (path, tree) in modules.items()
    }


def circle(edges: Mapping[str, set[str]]) -> list[str]:
    """Modules that import each other, in turn, if there are any."""
    try:
        TopologicalSorter(edges).prepare()
    except CycleError as error:
        return sorted(set(error.args[1]))
    return []


def by_string(tree: ast.Module) -> list[ast.Call]:
    """Calls that import by a name that is a value, or that run a text."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            bare = isinstance(node.func, ast.Name)
            name = (
                node.func.id
                if isinstance(node.func, ast.Name)
                else node.func.attr
                if isinstance(node.func, ast.Attribute)
                else ""
            )
            if name in BY_STRING or (bare and name in RUNS_TEXT):
                found.append(node)
    return found


@pytest.mark.parametrize("typing", [False, True], ids=["running", "with imports for types"])
def test_no_modules_import_each_other(typing):
    assert circle(graph(typing=typing)) == []


def test_imports_by_string_are_those_that_are_listed():
    found = {
        path.relative_to(ROOT / PACKAGE).as_posix()
        for path, tree in sources().values()
        if by_string(tree)
    }
    assert sorted(found - {*ALLOWED}) == [], (
        "use an import statement, within a function where it has to be lazy"
    )
    assert sorted({*ALLOWED} - found) == [], "listed, and no longer there"


def test_what_can_be_imported_by_a_statement_is():
    fixed = [
        f"{path.relative_to(ROOT)}:{call.lineno}"
        for path, tree in sources().values()
        for call in by_string(tree)
        if any(isinstance(argument, ast.Constant) for argument in call.args[:1])
    ]
    assert fixed == []


TRIED = "def f():\n    try:\n        from ..b import f\n    except ImportError: ...\n"
TYPED = (
    "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from house.a import g\nelse:\n   "
    " import json\n"
)


@pytest.mark.parametrize(
    ("files", "typing", "expected"),
    [
        (
            {"a.py": "from .sub.c import f\n", "b.py": "from house import a\n", "sub/c.py": TRIED},
            False,
            ["house.a", "house.b", "house.sub.c"],
        ),
        ({"a.py": "from house.b import f\n", "b.py": TYPED}, False, []),
        ({"a.py": "from house.b import f\n", "b.py": TYPED}, True, ["house.a", "house.b"]),
    ],
)
def test_circles_are_found_wherever_the_import_stands(files, typing, expected, tmp_path):
    for name, text in {"__init__.py": "", "sub/__init__.py": "", **files}.items():
        path = tmp_path / "house" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    assert circle(graph(tmp_path / "house", typing)) == expected


def test_an_import_by_string_is_seen():
    seen = [
        "load_target('a:b')",
        "importlib.import_module('a')",
        "__import__('a')",
        "exec('import a')",
        "runpy.run_module('a')",
    ]
    for text in (*seen, "import a", "re.compile('a')", "model.eval()"):
        assert len(by_string(ast.parse(f"def f():\n    {text}\n"))) == (text in seen), text
