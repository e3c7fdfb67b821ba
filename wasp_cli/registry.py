"""Registries of names: one for each package, with import strings, and entry points for plugins.

Listing names imports nothing heavy; `load` imports the module of the entry that is asked for.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib import metadata
from importlib.machinery import PathFinder
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, Protocol, TypeVar

from wasp_cli.errors import UnknownName, WaspError, described
from wasp_cli.own import hidden, misspelt, nearby, of_python


class Entry(Protocol):
    """What a registry holds: at least a name and an import string `module:attribute`."""

    @property
    def name(self) -> str:
        """The name under which it is listed and looked up."""
        ...

    @property
    def target(self) -> str:
        """The import string `module:attribute` of what it stands for."""
        ...


E = TypeVar("E", bound=Entry)


class Registry(Mapping[str, E], Generic[E]):
    """The entries of one package by name. Other packages add theirs through the entry-point group
    `group`.
    """

    def __init__(self, kind: str, group: str, entries: tuple[E, ...]) -> None:
        self.kind = kind
        self.group = group
        self._type = type(entries[0])
        self._own = {entry.name: entry for entry in entries}
        self._all: dict[str, E] | None = None

    @property
    def own(self) -> Mapping[str, E]:
        """The entries of this package, without those of plugins."""
        return self._own

    def plugins(self) -> Iterator[tuple[EntryPoint, E | WaspError]]:
        """Yield each entry point of another package, with its entry or with the error why it cannot
        be used.
        """
        names: set[str] = set()
        for point in entry_points(group=self.group):
            try:
                entry: E = _loaded(point)
                self._require_new(entry, point, names)
            except WaspError as error:
                yield point, error
            else:
                names.add(entry.name)
                yield point, entry

    def _require_new(self, entry: E, point: EntryPoint, names: set[str]) -> None:
        """Check that an entry point names an entry of this registry, with a name that nobody
        else has.
        """
        if not isinstance(entry, self._type):
            raise WaspError(
                f"the entry point '{point.name}' of group '{point.group}' is of type "
                f"{type(entry).__name__}",
                f"it should be of type {self._type.__name__}",
            )
        if entry.name in self._own:
            raise WaspError(
                f"plugin '{point.value}' redefines the built-in {self.kind} '{entry.name}'"
            )
        if entry.name in names:
            raise WaspError(
                f"two plugins name a {self.kind} '{entry.name}'", "uninstall one of them"
            )

    def _entries(self) -> dict[str, E]:
        if self._all is None:
            entries = dict(self._own)
            for _, entry in self.plugins():
                if isinstance(entry, WaspError):
                    raise entry
                entries[entry.name] = entry
            self._all = entries
        return self._all

    def __getitem__(self, name: str) -> E:
        try:
            return self._entries()[name]
        except KeyError:
            raise UnknownName(self.kind, name, self._entries()) from None

    def __contains__(self, name: object) -> bool:
        return name in self._entries()

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries())

    def __len__(self) -> int:
        return len(self._entries())

    def load(self, name: str) -> Any:
        """Import and return what an entry names. Raises UnknownName if there is no such entry, and
        WaspError if the code of a plugin cannot be imported.
        """
        return load_target(
            self[name].target, "" if name in self._own else f"the {self.kind} '{name}' of a plugin"
        )


def entry_points(group: str) -> Iterable[EntryPoint]:
    """Return the entry points of a group that installed packages have."""
    points: Iterable[EntryPoint] = _installed(tuple(sys.path)).select(group=group)
    return points


@cache
def _installed(path: tuple[str, ...]) -> Any:
    """The entry points of all packages on a path: to look for them reads a file of each package.
    Python 3.11 has another class for them than later ones; both can `select`.
    """
    return metadata.entry_points()


def _loaded(point: EntryPoint) -> Any:
    """What a plugin's entry point names; its code is another's, and may do anything."""
    source = (
        f"plugin '{point.dist.name if point.dist else point.module}' (entry point "
        f"'{point.name}' of group '{point.group}')"
    )
    try:
        return point.load()
    except Exception as error:
        raise WaspError(
            f"{source} does not load: {described(error)}", "repair the plugin, or uninstall it"
        ) from error


def require_spelling(kind: str, name: str) -> None:
    """Raise UnknownName if `module:Name` is misspelt: the module as a path, with a dash or with
    `.py`. The hint has the right spelling.
    """
    if (hint := misspelt(name)) is not None:
        raise UnknownName(kind, name, (), otherwise=hint)


def load_target(target: str, whose: str = "") -> Any:
    """Import and return what an import string names. For the code of others, `whose` begins the
    message of a failure.
    """
    module, _, attribute = target.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except Exception as error:
        if not whose:
            raise
        raise WaspError(
            f"{whose} does not load: {described(error)}",
            f"see '{target}'; wasp doctor names the package",
        ) from error


_SPEC_FOLDERS: list[str] = []
"""Where the files of the specs lie that this process has read, in their order."""


def search_beside(folders: Iterable[str | Path]) -> None:
    """Let `import_here` also search the folders of specs, after the current folder."""
    for folder in folders:
        absolute = os.path.abspath(folder)
        if absolute not in _SPEC_FOLDERS:
            _SPEC_FOLDERS.append(absolute)


def searched_beside() -> tuple[str, ...]:
    """Return the folders of specs that `import_here` searches, to pass them to another process."""
    return tuple(_SPEC_FOLDERS)


def import_here(module: str) -> ModuleType:
    """Import a module that a spec names. It may lie in the folder that the process was started in,
    or beside the file of the spec; these are searched last, so that they hide nothing that is
    installed.

    Raises:
        WaspError: it cannot be imported, or is a module of Python's standard library, which is
            never meant.
    """
    top = module.partition(".")[0]
    if (said := of_python(module)) is not None:
        raise WaspError(*said)
    try:
        for folder in (os.getcwd(), *_SPEC_FOLDERS):
            if importlib.util.find_spec(top) is not None:
                break
            if PathFinder.find_spec(top, [folder]) is not None:
                sys.path.append(folder)
                importlib.invalidate_caches()
        return importlib.import_module(module)
    except (Exception, SystemExit) as error:  # the code is another's
        hint = hidden(module) or _what_to_do(module, error)
        raise WaspError(f"module '{module}' does not import: {described(error)}", hint) from error


def _what_to_do(module: str, error: BaseException) -> str:
    """What to do about a module that raised an error when it was imported."""
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing is None:
        return "repair the module"
    if f"{module}.".startswith(f"{missing}."):
        return nearby(module)
    return f"install '{missing}', which it imports"


def remedy(module: str, otherwise: str) -> str:
    """Return what to do if a module lacks a name that a spec asks for: another module may hide the
    file that is meant, else `otherwise`.
    """
    return hidden(module) or otherwise


def module_of(target: str) -> str:
    """Return the module of an import string `module:attribute`."""
    return target.partition(":")[0]
