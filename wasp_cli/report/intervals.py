"""Intervals and contrasts that an earlier report has computed of the same rows.

    with intervals_kept(layout, "table1"):
        ...                               # `bootstrap.mean_of` and the others compute what is new

A bootstrap takes milliseconds, and a report has a thousand. What it finds is kept (`spec.kept`) by
what it is computed from: the rows of the cells, the column, and the code. So a claim that was
judged before is only put together again.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from wasp_cli.cells import table
from wasp_cli.cells.table import CellTable
from wasp_cli.report import summary
from wasp_cli.spec import kept
from wasp_cli.store.layout import Layout

P = ParamSpec("P")
Found = TypeVar("Found")
Plain = Any  # what JSON can hold


@dataclass
class _Kept:
    """What earlier reports have found, and what this one has asked for, by digest of its inputs."""

    known: dict[str, Plain]
    used: dict[str, Plain] = field(default_factory=dict)
    digests: WeakKeyDictionary[CellTable, str] = field(default_factory=WeakKeyDictionary)

    def digest_of(self, inputs: object) -> str:
        """The digest of arguments; of cells that of their rows."""
        if isinstance(inputs, CellTable):
            if inputs not in self.digests:
                self.digests[inputs] = _digest_of_cells(inputs)
            return self.digests[inputs]
        if isinstance(inputs, Sequence) and not isinstance(inputs, str):
            return f"[{','.join(map(self.digest_of, inputs))}]"
        return repr(inputs)


_computing: set[str] = set()
"""The modules whose functions are `remembered`."""
_current: ContextVar[_Kept | None] = ContextVar("intervals", default=None)


@contextmanager
def intervals_kept(layout: Layout, report: str) -> Iterator[None]:
    """Take what an earlier report of this name found in the block, and keep what is found in it."""
    place = hashlib.sha256(f"{layout.root.absolute()}\n{report}".encode()).hexdigest()[:20]
    name = f"intervals-{place}"
    computing = [sys.modules[module] for module in sorted(_computing)]
    code = kept.code_version(*computing, table, summary, sys.modules[__name__])
    version = f"{code}-numpy{np.__version__}"
    values = _Kept(kept.read_kept(name, version))
    token = _current.set(values)
    try:
        yield
    finally:
        _current.reset(token)
    if values.used.keys() - values.known.keys():
        kept.keep(name, version, values.used)


def remembered(
    to_plain: Callable[[Found], Plain], from_plain: Callable[[Plain], Found]
) -> Callable[[Callable[P, Found | None]], Callable[P, Found | None]]:
    """Make a function of cells compute only what `intervals_kept` does not know. Its values go to
    JSON and back by `to_plain` and `from_plain`; None is kept as it is.
    """

    def decorate(compute: Callable[P, Found | None]) -> Callable[P, Found | None]:
        _computing.add(compute.__module__)

        @wraps(compute)
        def looked_up(*args: P.args, **kwargs: P.kwargs) -> Found | None:
            values = _current.get()
            if values is None:
                return compute(*args, **kwargs)
            named = sorted(kwargs.items())
            inputs = f"{compute.__name__} {values.digest_of(args)} {values.digest_of(named)}"
            key = hashlib.sha256(inputs.encode()).hexdigest()[:32]
            if key in values.known:
                plain = values.known[key]
                found = None if plain is None else from_plain(plain)
            else:
                found = compute(*args, **kwargs)
                plain = None if found is None else to_plain(found)
            values.used[key] = plain
            return found

        return looked_up

    return decorate


def _digest_of_cells(cells: CellTable) -> str:
    digest = hashlib.sha256()
    for cell, count in zip(cells, cells.counts.tolist(), strict=True):
        digest.update(repr((cell.identity, cell.training, count)).encode())
    for name in sorted(cells.names):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(cells.episodes(name)).tobytes())
    return digest.hexdigest()
