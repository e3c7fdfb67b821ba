"""What a plan is made of: cells of the grid, trained parts, the nodes that compute both, and their
keys.

A key is a hash over everything that decides a node's bytes, and nothing else. In it: what the node
is, its resolved configuration, the keys of what it reads, the source of what it runs, and the major
and minor versions of the libraries that compute. Not in it: the name of the spec and of its
severities, the order of lists, paths, workers, devices.

The source is every project module that is imported, hashed without comments and docstrings: modules
are read, never imported, so that planning needs no torch. The package's registries are not followed
(their import strings name every task and method at once); a node names the modules that it loads
through them as further roots. In packages of others, such as a task of one's own, every module
counts as it is: what they keep in a `registry` or a `config` may be constants. So do the data
files that these modules name (`plan.data`).
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from wasp_cli.errors import WaspError
from wasp_cli.plan.data import EXTENSIONS, data_files, data_hash, data_path
from wasp_cli.store.reached import reached
from wasp_cli.tasks.foreign.assets import MARK, data_name, is_data

# raised when the meaning of artifacts changes in a way that no other part of the key shows
SCHEMA = 1
LIBRARIES = ("mujoco", "numpy", "stable-baselines3", "torch")
LENGTH = 20


def canonical(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(value: Any, length: int = LENGTH) -> str:
    return hashlib.sha256(canonical(value).encode()).hexdigest()[:length]


def key_of(identity: Mapping[str, Any]) -> str:
    return digest({**identity, "schema": SCHEMA, "libraries": libraries()})


def recipe_of(identity: Mapping[str, Any]) -> str:
    """Return what `identity` describes, whatever code and libraries compute it; its upstream
    are the recipes of what it reads.
    """
    return digest({**identity, "schema": SCHEMA})


@cache
def libraries() -> dict[str, str]:
    return {name: minor(_installed(name)) for name in LIBRARIES}


def _installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def minor(version: object) -> str:
    return ".".join(version.split(".")[:2]) if isinstance(version, str) else "absent"


@dataclass(frozen=True, order=True, slots=True)
class Cell:
    """One point of the evaluation grid: who assists whom, where, with which seed."""

    task: str
    method: str
    variant: str  # of the method: 'full', or an ablation
    operator: str  # `UNIMPAIRED` for the reference row
    severity: str | None  # name of the severity in the spec; enters no key
    value: float | Literal["auto"] | None
    seed: int

    def __str__(self) -> str:
        return f"{self.task} {self.who} seed {self.seed}"

    @property
    def who(self) -> str:
        return cell_label(self.method, self.variant, self.operator, self.value)


def cell_label(method: str, variant: str, operator: str, value: float | str | None) -> str:
    """Return the end of a cell's label: the assistant with its ablation, and who drives."""
    assistant = method if variant == "full" else f"{method}/{variant}"
    return f"{assistant} {driver_label(operator, value)}"


def driver_label(operator: str, value: float | str | None) -> str:
    """Return an operator and its severity as labels show them; `value` is None for the unimpaired
    one, and `auto` where a stage chooses it.
    """
    if value is None:
        return "unimpaired"
    return f"{operator}={value}" if isinstance(value, str) else f"{operator}={value:g}"


@dataclass(frozen=True, order=True, slots=True)
class Part:
    task: str
    kind: str
    seed: int  # the seed of the training chain

    def __str__(self) -> str:
        return f"{self.task} s{self.seed} {self.kind}"


@dataclass(frozen=True, eq=False, slots=True)
class Node:
    """One run of one stage. Two nodes with the same key produce the same bytes, so the key is
    the node.
    """

    kind: str
    task: str
    seed: int
    # what else identifies it: method, method_config, operator variant, value (evaluate,
    # calibration)
    axes: Mapping[str, Any]
    config: Mapping[str, Any]
    settings: Mapping[str, Any]
    # the nodes whose artifacts it reads, by the name under which its stage reads them: mostly their
    # kind
    needs: Mapping[str, Node]
    modules: tuple[str, ...]  # where its code begins; its key covers what these import
    key: str
    label: str  # for people: `goal1 s0 world_model`
    # nodes of a sort take about as long: the same stage, task and method at the same sizes,
    # whatever the seed and the operator
    sort: str
    recipe: str = ""  # what it is, whatever code computes it
    without: tuple[str, ...] = ()  # modules that its task imports and that it does not run

    @property
    def sources(self) -> dict[str, str]:
        """The hash by name of every module and data file of its code."""
        return source_hashes(self.modules, self.without)

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Node) and other.key == self.key

    def __str__(self) -> str:
        return self.label


def with_upstream(nodes: Iterable[Node]) -> list[Node]:
    ordered: dict[str, Node] = {}

    def visit(node: Node) -> None:
        for needed in node.needs.values():
            if needed.key not in ordered:
                visit(needed)
        ordered[node.key] = node

    for node in nodes:
        if node.key not in ordered:
            visit(node)
    return list(ordered.values())


def sort_of(kind: str, task: str, config: Mapping[str, Any], axes: Mapping[str, Any]) -> str:
    """Return what `Node.sort` is; a manifest tells the same four things of a node that was
    computed.
    """
    return digest(
        [kind, task, config, axes.get("method"), axes.get("method_config"), axes.get("round")], 16
    )


PACKAGE = "wasp_cli"
ORCHESTRATION = frozenset(
    [
        "cells",
        "cli",
        "compare",
        "console",
        "drive",
        "errors",
        "notebook",
        "plan",
        "report",
        "run",
        "spec",
        "video",
        "view",
        "web",
        "__main__",
    ]
)
"""Parts of the package that move no number, so that a better message re-runs nothing."""
CONFIGURATION = frozenset({"config", "configs"})
"""Our modules and folders of config models: the resolved values are in the key already, so
fields and their defaults do not count.
"""


def closure(roots: Iterable[str], without: Iterable[str] = ()) -> frozenset[str]:
    """Return what the code that begins with `roots` consists of: modules and data files by name.

    Args:
        roots: modules, which are followed through their imports; and data files of others' modules
            (`plan.data`), which are taken as they are.
        without: modules that are left out, with what only they import and the data files that
            they name.

    Raises:
        WaspError: the source of a root cannot be found.
    """
    left_out = frozenset(without)
    modules: set[str] = set()
    files: set[str] = set()
    for root in roots:
        if is_data(root):
            files.add(root)
            continue
        if _file(root) is None:
            hint = "check the module that the plugin's entry names; its source has to be installed"
            raise WaspError(f"the source of '{root}' cannot be found, so no key can cover it", hint)
        modules |= _reach(root, left_out)
    for module in left_out:
        files -= _data(module)
    for module in modules:
        if module.partition(".")[0] != PACKAGE:
            files |= _data(module)
    return frozenset(modules | files)


@cache
def data_hashes(roots: tuple[str, ...], without: tuple[str, ...] = ()) -> dict[str, str]:
    """Return the hash by name of every data file of a closure. Do not write into it."""
    names = sorted(closure(roots, without))
    return {name: source_hash(name) for name in names if is_data(name)}


@cache
def closure_hash(roots: tuple[str, ...], without: tuple[str, ...] = ()) -> str:
    """Return a hash over the source of a closure."""
    lines = [f"{name} {source_hash(name)}" for name in sorted(closure(roots, without))]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:20]


def source_hashes(roots: Iterable[str], without: Iterable[str] = ()) -> dict[str, str]:
    """Return the hash by module of the closure: the manifest keeps them, so that a later plan
    can name what changed.
    """
    return {name: source_hash(name) for name in sorted(closure(roots, without))}


@cache
def source_hash(module: str) -> str:
    """Return the hash of one module's syntax without docstrings, or of a data file's bytes, as
    they were when they were first read here.
    """
    return _hash(module, _stamp(module))


def changed_since(hashes: Mapping[str, str]) -> list[str]:
    """Return the modules whose source is not what `source_hashes` once said; reads again only
    what was written since.
    """
    changed = []
    for module, known in hashes.items():
        try:
            now = _hash(module, _stamp(module))
        except (OSError, SyntaxError, ValueError):  # removed, or half saved
            now = ""
        changed += [module] if now != known else []
    return changed


def _stamp(module: str) -> tuple[int, int]:
    """Time of the last write and size of the file of a module or of data; zeros where a module has
    none. Taken before a file is read.
    """
    file = _data_file(module) if is_data(module) else _file(module)
    state = file.stat() if file is not None else None
    return (state.st_mtime_ns, state.st_size) if state is not None else (0, 0)


@cache
def _hash(module: str, stamp: tuple[int, int]) -> str:
    if is_data(module):
        return data_hash(_data_file(module))
    tree = _tree(module, stamp)
    parts = module.split(".")
    configured = parts[0] == PACKAGE and not CONFIGURATION.isdisjoint(parts[-2:])
    texts: list[str] = []
    _syntax(_configured(tree) if configured else tree, texts)
    return hashlib.sha256("".join(texts).encode()).hexdigest()[:12]


@cache
def _reach(root: str, without: frozenset[str]) -> set[str]:
    return reached([root], lambda module: _imports(module) - without)


@cache
def _imports(module: str) -> frozenset[str]:
    """Project modules that a module imports anywhere, functions included, except for type
    checking only.
    """
    imported = {name for name in _asked(module) if _file(name) is not None}
    # Importing a.b.c runs a.b as well; the package's own __init__ does not count.
    parts = [name.split(".") for name in imported]
    parents = {".".join(names[:length]) for names in parts for length in range(2, len(names))}
    return frozenset(imported | {parent for parent in parents if _counts(parent)})


@cache
def _asked(module: str) -> frozenset[str]:
    """The names that a module imports and that keys follow: modules, and attributes of modules."""
    file = _file(module)
    is_package = file is not None and file.name == "__init__.py"
    package = module if is_package else module.rpartition(".")[0]
    own = module.partition(".")[0]
    asked: set[str] = set()
    for node in _running(_tree(module, _stamp(module))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*above, base] if base else above)
            # `from package import module` and `from module import name` look alike.
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)]
        else:
            continue
        asked |= {name for name in names if _ours(name.partition(".")[0], own) and _counts(name)}
    return frozenset(asked)


@cache
def _data(module: str) -> frozenset[str]:
    """The data files of a module of others, by name: those that it names, and compiled modules."""
    top = module.partition(".")[0]
    file = _file(module)
    home = _home(top)
    if file is None or home is None:
        return frozenset()
    files = data_files(_tree(module, _stamp(module)), file, home)
    for name in _asked(module):
        path = home.joinpath(*name.split("."))
        if _file(name) is None and path.parent.is_dir():
            compiled = path.parent.glob(f"{path.name}.*")
            files += [each for each in compiled if each.suffix in EXTENSIONS]
    return frozenset(data_name(each, top, home) for each in files)


def _data_file(name: str) -> Path:
    """Where a data file lies. Raises OSError where the module is gone that it belongs to."""
    home = _home(name.partition(MARK)[0])
    if home is None:
        raise FileNotFoundError(name)
    return data_path(name, home)


@cache
def _ours(top: str, own: str) -> bool:
    """Whether keys follow an import: into this package, into one's own, or to what lies beside
    that in no folder of installed packages.
    """
    home = _home(own) if own != PACKAGE else None
    return top in (PACKAGE, own) or (
        home is not None
        and home == _home(top)
        and home.name not in ("site-packages", "dist-packages")
    )


def _home(top: str) -> Path | None:
    file = _file(top)
    return (
        None if file is None else file.parent.parent if file.name == "__init__.py" else file.parent
    )


def _counts(module: str) -> bool:
    parts = module.split(".")
    if parts[0] != PACKAGE:
        return True
    # The package's own __init__ holds its version.
    return len(parts) > 1 and parts[1] not in ORCHESTRATION and parts[-1] != "registry"


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
            body.append(
                ast.ClassDef(
                    statement.name,
                    statement.bases,
                    statement.keywords,
                    rest,
                    statement.decorator_list,
                )
            )
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


@cache
def _tree(module: str, stamp: tuple[int, int]) -> ast.Module:
    file = _file(module)
    return ast.Module([], []) if file is None else ast.parse(file.read_bytes(), filename=str(file))


@cache
def _file(module: str) -> Path | None:
    """The source of a module, found without importing anything; None for a namespace package,
    or when there is none.
    """
    top, _, rest = module.partition(".")
    try:
        spec = find_spec(top)
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    if not rest:
        return (
            Path(spec.origin) if spec.origin is not None and spec.origin.endswith(".py") else None
        )
    for folder in spec.submodule_search_locations or ():
        path = Path(folder).joinpath(*rest.split("."))
        for candidate in (path / "__init__.py", path.with_name(path.name + ".py")):
            if candidate.is_file():
                return candidate
    return None
