"""The data files of a foreign environment: which files it opens while it is made and reset.

A data file is named `top:path`: the top-level module that it belongs to, and its path from the
folder in which that module lies, with forward slashes. `mapped:mapped.json` lies beside
`mapped.py`, and `my_env:my_env/maps/a.npz` in the package `my_env`. No module has a colon in its
name, so that keys and manifests can list modules and data files together.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from wasp_cli.errors import TaskError

MARK = ":"
CODE = frozenset({".py", ".pyc", ".pyi", ".pyo"})
"""Suffixes of Python's own files: their syntax is hashed, not their bytes."""
INSTALLED = frozenset({"site-packages", "dist-packages"})
"""Names of folders in which many packages lie side by side."""
SYSTEM = ("/bin", "/dev", "/etc", "/lib", "/opt", "/proc", "/run", "/sbin", "/sys", "/usr", "/var")
_WRITES = os.O_WRONLY | os.O_RDWR
_watches: list[Watch] = []


class Home(NamedTuple):
    """Where a top-level module lies."""

    above: Path  # the folder that holds the module
    folder: Path  # the folder whose files are its own: of a package its folder, else `above`


class Watch:
    """The files that this process opens while it is watched, by Python's own functions."""

    def __init__(self) -> None:
        self.read: set[str] = set()
        self.written: set[str] = set()

    def saw(self, path: object, mode: object, flags: object) -> None:
        """Note a file that is opened; arguments are those of Python's audit event `open`."""
        if not isinstance(path, str | bytes | os.PathLike):
            return  # a file descriptor: the file was opened before
        name = os.path.abspath(os.fsdecode(path))
        by_mode = isinstance(mode, str) and not set(mode).isdisjoint("wax+")
        by_flags = isinstance(flags, int) and flags & _WRITES != 0
        if by_mode or by_flags:
            self.written.add(name)
        else:
            self.read.add(name)

    def files(self) -> Iterator[Path]:
        """Yield every file that was read and not written, where it is still there."""
        for name in sorted(self.read - self.written):
            path = Path(name)
            if path.suffix not in CODE and path.is_file():
                yield path


@contextmanager
def watched() -> Iterator[Watch]:
    """Watch which files are opened in the block."""
    _listen()
    watch = Watch()
    _watches.append(watch)
    try:
        yield watch
    finally:
        _watches.remove(watch)


@cache
def _listen() -> None:
    """Add the audit hook of this process, once: Python cannot take one away again."""
    sys.addaudithook(_heard)


def _heard(event: str, arguments: tuple[Any, ...]) -> None:
    if not _watches:
        return
    """Note what Python's audit events say of files that are opened."""
    if event == "open":
        path, mode, flags = arguments
    elif event == "sqlite3.connect":
        path = arguments[0]
        mode = "r"
        flags = 0
    else:
        return
    for watch in _watches:
        watch.saw(path, mode, flags)


def data_name(file: Path, top: str, home: Path) -> str:
    """Return the name of a file that the module `top` reads, which lies in the folder `home`."""
    return f"{top}{MARK}{Path(os.path.relpath(file, home)).as_posix()}"


def is_data(name: str) -> bool:
    """Return whether a name of a closure is that of a data file, and not of a module."""
    return MARK in name


def is_hidden(name: str) -> bool:
    """Return whether a file or folder is of no interest to keys: hidden, or compiled by Python."""
    return name.startswith(".") or name == "__pycache__"


def files_below(path: Path) -> Iterator[Path]:
    """Yield a file, or every file of a folder and of the folders in it; nothing of what is hidden.

    A path that is not there yields nothing.
    """
    if path.is_file():
        yield path
    elif path.is_dir():
        for folder, folders, names in os.walk(path):
            folders[:] = [name for name in folders if not is_hidden(name)]
            yield from (Path(folder, name) for name in names if not is_hidden(name))


def home_of(top: str) -> Home | None:
    """Return where a top-level module lies; None where it has no folder: it is built in, or a
    namespace.
    """
    try:
        spec = find_spec(top)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin is None or not spec.has_location:
        return None
    file = Path(spec.origin)
    if spec.submodule_search_locations is not None:
        return Home(file.parent.parent, file.parent)
    return Home(file.parent, file.parent)


def _homes(modules: Iterable[str]) -> dict[str, Home]:
    """Where the top-level modules of some modules lie, by name and in their order."""
    homes: dict[str, Home] = {}
    for module in modules:
        top = module.partition(".")[0]
        home = home_of(top)
        if home is not None:
            homes[top] = home
    return homes


def own_files(watch: Watch, modules: Iterable[str]) -> tuple[list[str], list[Path]]:
    """Sort the files that were read by whether they belong to one of some modules.

    Returns:
        The names of those that lie in the folder of a module; and the paths of others, which no
        key covers. Files of the system, of Python and of installed packages are left out.
    """
    homes = _homes(modules)
    names: list[str] = []
    others: list[Path] = []
    for file in watch.files():
        name = _owned(file, homes)
        if name is not None:
            names.append(name)
        elif not _is_of_system(file):
            others.append(file)
    return names, others


def _is_of_system(file: Path) -> bool:
    """Whether a file belongs to the machine or to an installation, and not to an experiment."""
    if not INSTALLED.isdisjoint(file.parts) or any(map(is_hidden, file.parts)):
        return True
    folders = (sys.prefix, sys.base_prefix, *SYSTEM)
    return any(Path(folder) in file.parents for folder in folders)


def _owned(file: Path, homes: Mapping[str, Home]) -> str | None:
    """The name of a file that lies in the folder of a module; None where it lies in none."""
    for top, home in homes.items():
        if home.folder.name in INSTALLED or home.folder not in file.parents:
            continue
        if any(map(is_hidden, file.relative_to(home.folder).parts)):
            continue
        return data_name(file, top, home.above)
    return None


def declared_files(assets: object, modules: Iterable[str], whose: str = "it") -> list[str]:
    """Return the names of the files that an environment or an assistant lists as its `assets`.

    Args:
        assets: paths of files and folders; relative ones begin at the folder of the first of
            `modules` that has one.
        modules: where its code begins.
        whose: what it is called in messages.

    Raises:
        TaskError: it is no list of paths, or one is not there.
    """
    if isinstance(assets, str) or not isinstance(assets, Iterable):
        raise TaskError(f"{whose} has `assets` = {assets!r}", "a list of files or folders")
    homes = _homes(modules)
    if not homes:
        raise TaskError(f"{whose} has `assets`, but its module lies in no folder")
    top, home = next(iter(homes.items()))
    names: list[str] = []
    for asset in assets:
        if not isinstance(asset, str | os.PathLike):
            raise TaskError(f"{whose} has {asset!r} in `assets`", "a path of a file or a folder")
        path = home.folder / os.fspath(asset)
        files = sorted(files_below(path))
        if not files:
            raise TaskError(
                f"{whose} has '{asset}' in `assets`, which is not there",
                f"'{path}' is no file, and no folder with files; relative paths begin at the "
                f"folder of the module '{top}'",
            )
        names += [data_name(file, top, home.above) for file in files]
    return names
