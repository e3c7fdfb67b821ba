"""Vectors in the observations of others: entries of an observation, one after the other.

A dictionary of dictionaries is flat here, its entries in the order of their names; the name of an
entry has dots between its parts. An entry of a tuple is named by its place.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.foreign.images import AS_SAID

Space = gymnasium.Space[Any]
Path = tuple[str, ...]
"""The names on the way to an entry; empty for the whole observation."""


@dataclass(frozen=True)
class Entry:
    """An entry that is a vector."""

    path: Path
    size: int  # numbers in it
    # for one of several values (`Discrete`), the first of them: the vector is 1 at its place
    first: int | None = None

    def of(self, observation: Any) -> Floats:
        """Return its values [N] in an observation.

        Raises:
            TaskError: they are not there, are not as many as the space says, or not finite.
        """
        given = entry_of(observation, self.path)
        name = said(self.path)
        if self.first is not None:
            return self._one_hot(given, name)
        try:
            values: Floats = np.asarray(given, np.float64).ravel()
        except (TypeError, ValueError) as error:
            raise TaskError(f"{name} is no array of numbers: {type(given).__name__}") from error
        if values.size != self.size:
            raise TaskError(f"{name} has {values.size} values, its space has {self.size}")
        if not np.isfinite(values).all():
            raise TaskError(f"{name} is not finite: {values.tolist()}")
        return values

    def _one_hot(self, given: Any, name: str) -> Floats:
        """1 at the place of a value, 0 elsewhere."""
        values = np.zeros(self.size)
        place = int(given) - (self.first or 0)
        if not 0 <= place < self.size:
            raise TaskError(f"{name} is {given!r}, which its space does not have", AS_SAID)
        values[place] = 1.0
        return values


@dataclass(frozen=True)
class Vector:
    """Entries of an observation, one after the other."""

    entries: tuple[Entry, ...]

    @property
    def size(self) -> int:
        """Numbers in all of them."""
        return sum(entry.size for entry in self.entries)

    @property
    def names(self) -> list[str]:
        """The entries by name; an empty name is the whole observation."""
        return [".".join(entry.path) for entry in self.entries]

    def of(self, observation: Any) -> Floats:
        """Return the values [N] of an observation. Errors as of `Entry.of`."""
        return np.concatenate([entry.of(observation) for entry in self.entries])


def leaves(space: Space, path: Path = ()) -> Iterator[tuple[Path, Space]]:
    """Yield every entry of a space that has none below it, in the order of their names."""
    if isinstance(space, gymnasium.spaces.Dict):
        for name in sorted(space.spaces, key=str):
            yield from leaves(space.spaces[name], (*path, str(name)))
    elif isinstance(space, gymnasium.spaces.Tuple):
        for place, part in enumerate(space.spaces):
            yield from leaves(part, (*path, str(place)))
    else:
        yield path, space


def entry_space(space: Space, path: Path) -> Space | None:
    """Return the space of an entry; None where there is no such entry."""
    for name in path:
        below: Space | None = None
        if isinstance(space, gymnasium.spaces.Dict):
            below = space.spaces.get(name)
        elif isinstance(space, gymnasium.spaces.Tuple) and name.isdecimal():
            below = space.spaces[int(name)] if int(name) < len(space.spaces) else None
        if below is None:
            return None
        space = below
    return space


def vector_entry(path: Path, space: Space) -> Entry | None:
    """Return an entry as a vector; None where its space has no numbers, as a text has none."""
    if isinstance(space, gymnasium.spaces.Discrete):
        return Entry(path, int(space.n), int(space.start))
    is_array = isinstance(space, gymnasium.spaces.Box | gymnasium.spaces.MultiBinary)
    size = int(np.prod(space.shape or ())) if is_array else 0
    return Entry(path, size) if size else None


def entry_of(observation: Any, path: Path) -> Any:
    """Return an entry of an observation. Raises TaskError where it has no such entry."""
    part = observation
    for depth, name in enumerate(path):
        if isinstance(part, Mapping) and name in part:
            part = part[name]
        elif isinstance(part, tuple | list) and name.isdecimal() and int(name) < len(part):
            part = part[int(name)]
        else:
            message = f"its observation has no '{'.'.join(path)}': {_holds(part, depth)}"
            raise TaskError(message, AS_SAID)
    return part


def said(path: Path) -> str:
    """Return what an entry is called in messages."""
    return f"its observation '{'.'.join(path)}'" if path else "its observation"


def _holds(part: Any, depth: int) -> str:
    where = "" if depth == 0 else "there are "
    if isinstance(part, Mapping):
        return f"{where}entries {list(part)}"
    return type(part).__name__


def known(space: Space) -> str:
    """Return the names of the entries of a space, for messages."""
    names = [".".join(path) for path, _ in leaves(space) if path]
    return "entries: " + ", ".join(names) if names else "it has no entries"
