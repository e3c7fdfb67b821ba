"""The source of what a node runs: the modules behind it, and a hash of each.

Every project module that is imported counts, hashed without comments and docstrings. Modules are
read, never imported, so that planning needs no torch. The package's registries are not followed,
since their import strings name every task and method at once; a node names the modules that it
loads through them as further roots. In other packages, such as a task of one's own, every module
counts as a whole, since a module called `registry` or `config` may have constants there. The data
files that these modules name count too (`plan.data`).
"""

from __future__ import annotations

import ast
import hashlib
import os
import re
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from wasp_cli.errors import WaspError
from wasp_cli.plan.data import EXTENSIONS, data_files, data_hash, data_path
from wasp_cli.plan.syntax import Source, read_source
from wasp_cli.store.reached import reached
from wasp_cli.tasks.foreign.assets import MARK, data_name, is_data

PACKAGE = "wasp_cli"
ORCHESTRATION = frozenset(
    [
        "cells",
        "cli",
        "compare",
        "console",
        "drive",
        "errors",
        "export",
        "leaderboard",
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
    """Return the code that begins with `roots`: modules and data files by name.

    Args:
        roots: modules, which are followed through their imports; and data files of others' modules
            (`plan.data`), which are taken as they are.
        without: modules that are left out, with what only they import and the data files that they
            name.

    Raises:
        WaspError: the source of a root cannot be found.
        SyntaxError: a module is not valid Python.
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
    """Return the hash by name of every data file of a closure. The mapping is shared; do not write
    into it.
    """
    hashes = _source_hashes(roots, without)
    return {name: known for name, known in hashes.items() if is_data(name)}


@cache
def closure_hash(roots: tuple[str, ...], without: tuple[str, ...] = ()) -> str:
    """Return a hash over the source of a closure, as keys have it. Raises as `closure` does."""
    lines = [f"{name} {known}" for name, known in _source_hashes(roots, without).items()]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:20]


def source_hashes(roots: Iterable[str], without: Iterable[str] = ()) -> dict[str, str]:
    """Return the hash by module of the closure: the manifest keeps them, so that a later plan
    can name what changed.
    """
    return dict(_source_hashes(tuple(roots), tuple(without)))


@cache
def _source_hashes(roots: tuple[str, ...], without: tuple[str, ...]) -> dict[str, str]:
    return {name: source_hash(name) for name in sorted(closure(roots, without))}


@cache
def source_hash(module: str) -> str:
    """Return the hash of one module's syntax without docstrings, or of a data file's bytes, as
    they were when they were first read here.
    """
    return _hash(module, _stamp(module))


def changed_since(hashes: Mapping[str, str]) -> list[str]:
    """Return the modules whose source differs from earlier `source_hashes`. Only files that were
    written since are read again.
    """
    changed = []
    for module, known in hashes.items():
        try:
            now = _hash(module, _stamp(module))
        except (OSError, SyntaxError, ValueError):  # removed, or half saved
            now = ""
        if now != known:
            changed.append(module)
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
    return _source(module, stamp).syntax


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
    for statement in _source(module, _stamp(module)).imports:
        names = list(statement.names)
        if statement.level >= 0:
            base = statement.module
            if statement.level:
                above = package.split(".")[: len(package.split(".")) - statement.level + 1]
                base = ".".join([*above, base] if base else above)
            # `from package import module` and `from module import name` look alike.
            names = [base, *(f"{base}.{name}" for name in statement.names)]
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


def own_files(roots: Iterable[str], without: Iterable[str] = ()) -> dict[str, Path]:
    """Return the files of a closure that are not this package's: modules, the packages that they
    are in, and data.

    Their names are paths below the folder that holds the top-level module, so that copies under
    these names in another folder can be imported from there.
    """
    files: dict[str, Path] = {}
    for name in sorted(closure(roots, without)):
        top = re.split(rf"[.{MARK}]", name)[0]
        home = _home(top)
        if top == PACKAGE or home is None:
            continue
        if is_data(name):
            found = [_data_file(name)]
        else:
            found = [file for file in (_file(top), _file(name)) if file is not None]
        for file in found:
            files[os.path.relpath(file, home).replace(os.sep, "/")] = file
    return files


def _data_file(name: str) -> Path:
    """The path of a data file. Raises OSError if the module that it belongs to is gone."""
    home = _home(name.partition(MARK)[0])
    if home is None:
        raise FileNotFoundError(name)
    return data_path(name, home)


@cache
def _ours(top: str, own: str) -> bool:
    """Whether keys follow an import: into this package, into one's own, or to a module beside it
    that is not in a folder of installed packages.
    """
    if top in (PACKAGE, own):
        return True
    if own == PACKAGE:
        return False
    home = _home(own)
    if home is None or home.name in ("site-packages", "dist-packages"):
        return False
    return home == _home(top)


def _home(top: str) -> Path | None:
    """The folder that a package is imported from, or a module that is in no package."""
    file = _file(top)
    if file is None:
        return None
    return file.parent.parent if file.name == "__init__.py" else file.parent


def _counts(module: str) -> bool:
    """Whether a module of the package can change numbers; modules of other packages all count."""
    parts = module.split(".")
    if parts[0] != PACKAGE:
        return True
    # The package's own __init__ holds its version.
    return len(parts) > 1 and parts[1] not in ORCHESTRATION and parts[-1] != "registry"


@cache
def _source(module: str, stamp: tuple[int, int]) -> Source:
    file = _file(module)
    parts = module.split(".")
    configured = parts[0] == PACKAGE and not CONFIGURATION.isdisjoint(parts[-2:])
    data = b"" if file is None else file.read_bytes()
    return read_source(data, str(file), configured=configured)


@cache
def _tree(module: str, stamp: tuple[int, int]) -> ast.Module:
    file = _file(module)
    return ast.Module([], []) if file is None else ast.parse(file.read_bytes(), filename=str(file))


@cache
def _file(module: str) -> Path | None:
    """The source of a module, found without importing anything; None for a namespace package, or if
    there is none.
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
