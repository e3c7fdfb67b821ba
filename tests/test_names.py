"""A name means one thing: no function that is made inside another one reads a name that is
assigned again afterwards, since it would read the later value.

Ruff's B023 finds the loop variables that such a function would read too late. This finds the rest.
"""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("wasp_cli", "docs", "tests")

FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
SCOPES = (*FUNCTIONS, *COMPREHENSIONS, ast.ClassDef)
NAMED = (
    ast.FunctionDef,
    ast.AsyncFunctionDef,
    ast.ClassDef,
    ast.ExceptHandler,
    ast.MatchAs,
    ast.MatchStar,
)


class Rebound(NamedTuple):
    line: int  # of the function that reads the name
    name: str
    again: int  # the line that assigns it again


def rebound(tree: ast.Module) -> list[Rebound]:
    """Return the names that a function, a lambda or a generator reads, and that the scope around
    it assigns again below.
    """
    found = []
    for scope in ast.walk(tree):
        if not isinstance(scope, (ast.Module, *FUNCTIONS)):
            continue
        assigned = list(assignments(scope))
        for later in run_later(scope):
            above = {name for name, line in assigned if line <= later.lineno} | arguments(scope)
            read = read_from_around(later) & above
            end = later.end_lineno or later.lineno
            found += [
                Rebound(later.lineno, name, line)
                for name, line in assigned
                if line > end and name in read
            ]
    return found


def within(scope: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes of a scope, and the scopes in it without what is in them."""
    pending = own_nodes(scope)
    while pending:
        node = pending.pop(0)
        yield node
        if isinstance(node, COMPREHENSIONS):
            # the first iterable is read when the comprehension is made, in the scope around it
            pending.append(node.generators[0].iter)
        elif not isinstance(node, SCOPES):
            pending += ast.iter_child_nodes(node)


def own_nodes(scope: ast.AST) -> list[ast.AST]:
    """Return what runs when a scope does: not the arguments and decorators of a function."""
    if isinstance(scope, ast.Lambda):
        return [scope.body]
    if isinstance(scope, COMPREHENSIONS):
        first = scope.generators[0].iter
        parts = [
            *(
                node
                for node in ast.iter_child_nodes(scope)
                if not isinstance(node, ast.comprehension)
            ),
            *(node for each in scope.generators for node in ast.iter_child_nodes(each)),
        ]
        return [node for node in parts if node is not first]
    return list(scope.body)


def assignments(scope: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield every name that a scope assigns, with the line."""
    for node in within(scope):
        if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load):
            yield node.id, node.lineno
        elif isinstance(node, NAMED) and node.name:
            yield node.name, node.lineno
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            for alias in node.names:
                yield alias.asname or alias.name.partition(".")[0], node.lineno


def arguments(scope: ast.AST) -> set[str]:
    """Return the names of the arguments of a scope; only functions have some."""
    if not isinstance(scope, FUNCTIONS):
        return set()
    return {node.arg for node in ast.walk(scope.args) if isinstance(node, ast.arg)}


def run_later(scope: ast.AST) -> Iterator[ast.AST]:
    """Yield the functions and generators that a scope makes, and that run when it has gone on.

    A key for sorting is called at once; of generators, only one that gets a name is read later.
    """
    keys = {
        id(node.value)
        for node in within(scope)
        if isinstance(node, ast.keyword) and node.arg == "key"
    }
    for node in within(scope):
        if isinstance(node, FUNCTIONS) and id(node) not in keys:
            yield node
        elif isinstance(node, ast.ClassDef):
            yield from (each for each in within(node) if isinstance(each, FUNCTIONS))
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if isinstance(targets[0], ast.Name) and isinstance(node.value, ast.GeneratorExp):
                yield node.value


def read_from_around(scope: ast.AST) -> set[str]:
    """Return the names that a scope and those in it read, and do not assign.

    Of a name that a function declares `nonlocal` or `global`, it says itself that it changes.
    """
    own = arguments(scope) | {name for name, _ in assignments(scope)}
    read: set[str] = set()
    for node in within(scope):
        if isinstance(node, (ast.Nonlocal, ast.Global)):
            own |= set(node.names)
        elif isinstance(node, SCOPES):
            read |= read_from_around(node)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            read.add(node.id)
    return read - own


def sources() -> list[Path]:
    return [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]


def test_no_name_that_a_function_reads_is_assigned_again_below_it():
    wrong = [
        f"{path.relative_to(ROOT)}:{found.line}: reads '{found.name}', which line {found.again} "
        "assigns again; give one of them another name"
        for path in sources()
        for found in rebound(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (
            "def f(x):\n    goals = 7\n    def won(n): return n >= goals\n    goals = x > 1\n",
            [(3, "goals", 4)],
        ),
        ("def f(x):\n    won = lambda n: n >= x\n    x = 1\n    return won\n", [(2, "x", 3)]),
        (
            "def f(x):\n    k = 2\n    all_ = (n * k for n in x)\n    k = 3\n    return all_\n",
            [(3, "k", 4)],
        ),
        (
            "def f(x):\n    def won(): return [n for n in x if n]\n    for x in won(): pass\n",
            [(2, "x", 3)],
        ),
        (
            "def f():\n    n = 0\n    def tell(): print(n)\n    while True:\n        n += 1\n",
            [(3, "n", 5)],
        ),
        (
            "limit = 1\ndef f():\n    return limit\nlimit = 2\n",
            [(2, "limit", 4)],
        ),
        (
            "def f(k):\n    class C:\n        def m(self): return k\n    k = 1\n    return C\n",
            [(3, "k", 4)],
        ),
        # what is read at once, what a function has of its own, and what it says it shares
        ("def f(x):\n    k = 2\n    y = max(x, key=lambda n: n * k)\n    k = y\n", []),
        ("def f(x):\n    k = 2\n    y = sum(n * k for n in x)\n    k = y\n", []),
        ("def f(x):\n    g = (n for n in x)\n    x = 1\n    return g\n", []),
        ("def f(k):\n    def g(k): return k\n    k = 2\n    return g\n", []),
        ("def f(k):\n    def g(): return [k for k in range(3)]\n    k = 2\n    return g\n", []),
        (
            "def f(k):\n    def g():\n        nonlocal k\n        k += 1\n    k = 2\n",
            [],
        ),
        ("def f():\n    def g(): return k\n    k = 2\n    return g\n", []),
    ],
)
def test_a_name_that_changes_under_a_function_is_found(text, found):
    assert rebound(ast.parse(text)) == found
