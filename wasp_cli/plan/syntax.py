"""What a key needs of a source file: a hash of its syntax, and what it imports.

Parsing and walking the package's files takes longer than the rest of a plan. The results are
therefore kept (`spec.kept`) by the bytes of each file, not by its time.
"""

from __future__ import annotations

import ast
import copy
import hashlib
import sys
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

from wasp_cli.spec import kept

NAME = "sources"
MOST = 3000  # files that are kept; the package has a few hundred, and each edit makes one more


class Import(NamedTuple):
    """One import statement. For `import a, b` the module is empty, and the names are modules."""

    module: str
    names: tuple[str, ...]
    level: int  # dots of a relative import; -1 of `import a, b`


class Source(NamedTuple):
    """What a key needs of a source file."""

    syntax: str  # 12 digits of the SHA-256 of its syntax, without comments and docstrings
    imports: tuple[Import, ...]  # also those inside functions; not those for type checking only


class _Kept:
    """The sources that were read before, by the digest of a file's bytes."""

    def __init__(self) -> None:
        self.known: dict[str, Source] = {}
        for digest, (syntax, imports) in kept.read_kept(NAME, _version()).items():
            statements = [Import(module, tuple(names), level) for module, names, level in imports]
            self.known[digest] = Source(syntax, tuple(statements))
        self.used: set[str] = set()
        self.grown = False


@cache
def _kept() -> _Kept:
    return _Kept()


def _version() -> str:
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    return f"{kept.code_version(sys.modules[__name__])}-{python}"


def read_source(data: bytes, name: str, *, configured: bool) -> Source:
    """Return what a key needs of a file.

    Args:
        data: its bytes.
        name: for the error.
        configured: whether it has config models, whose fields do not count.

    Raises:
        SyntaxError: it is not valid Python.
        ValueError: it has a null byte.
    """
    sources = _kept()
    digest = f"{hashlib.sha256(data).hexdigest()[:40]}{'c' if configured else ''}"
    found = sources.known.get(digest)
    if found is None:
        tree = ast.parse(data, filename=name)
        found = Source(syntax_hash(tree, configured=configured), tuple(_imports(tree)))
        sources.known[digest] = found
        sources.grown = True
    sources.used.add(digest)
    return found


def keep_sources() -> None:
    """Keep what was read since the last call."""
    sources = _kept()
    if not sources.grown:
        return
    digests = set(sources.known) if len(sources.known) <= MOST else sources.used
    values: dict[str, Any] = {digest: sources.known[digest] for digest in sorted(digests)}
    kept.keep(NAME, _version(), values)
    sources.grown = False


def syntax_hash(tree: ast.Module, *, configured: bool) -> str:
    """Return 12 hexadecimal digits of the SHA-256 of a syntax tree; `configured` is that of
    `read_source`.
    """
    texts: list[str] = []
    _syntax(_configured(tree) if configured else tree, texts)
    return hashlib.sha256("".join(texts).encode()).hexdigest()[:12]


def _imports(tree: ast.Module) -> Iterator[Import]:
    for node in _running(tree):
        if isinstance(node, ast.Import):
            yield Import("", tuple(alias.name for alias in node.names), -1)
        elif isinstance(node, ast.ImportFrom):
            names = tuple(alias.name for alias in node.names)
            yield Import(node.module or "", names, node.level)


def _running(tree: ast.AST) -> Iterator[ast.AST]:
    pending: list[ast.AST] = [tree]
    while pending:
        node = pending.pop()
        yield node
        if isinstance(node, ast.expr):
            continue  # no import hides in an expression
        if isinstance(node, ast.If) and "TYPE_CHECKING" in (
            getattr(node.test, "attr", ""),
            getattr(node.test, "id", ""),
        ):
            pending.extend(node.orelse)
        else:
            pending.extend(ast.iter_child_nodes(node))


def _configured(tree: ast.Module) -> ast.Module:
    """A module of config models without their fields; what is left are constants and methods."""
    body: list[ast.stmt] = []
    for statement in tree.body:
        if not isinstance(statement, ast.ClassDef):
            body.append(statement)
            continue
        rest: list[ast.stmt] = [
            part for part in statement.body if isinstance(part, ast.FunctionDef)
        ]
        if rest:
            without_fields = copy.copy(statement)
            without_fields.body = rest
            body.append(without_fields)
    return ast.Module(body, [])


_NO_SYNTAX = frozenset({"ctx", "type_comment"})


def _syntax(node: ast.AST, into: list[str]) -> None:
    """The syntax as text, the same on every Python: no positions, and empty parts left out (new
    versions add fields).

    Into one list: planning spends most of its time here, and a generator in each of a million nodes
    takes twice as long.
    """
    into.append(type(node).__name__)
    for name in node._fields:
        value = getattr(node, name, None)
        if value is None or name in _NO_SYNTAX:
            continue
        if isinstance(value, ast.AST):
            into.append(f"({name}")
            _syntax(value, into)
        elif isinstance(value, list):
            items = [item for item in value if not _is_text(item)]
            if not items or items == [None]:
                continue
            into.append(f"({name}")
            for item in items:
                if isinstance(item, ast.AST):
                    _syntax(item, into)
                else:
                    into.append(repr(item))
        else:
            into.append(f"({name}{value!r}")
        into.append(")")


def _is_text(item: object) -> bool:
    """A string that stands alone: the docstring of a module, a class, a function or an
    attribute.
    """
    return (
        isinstance(item, ast.Expr)
        and isinstance(item.value, ast.Constant)
        and isinstance(item.value.value, str)
    )
