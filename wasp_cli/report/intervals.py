"""Keeps the intervals and contrasts that a report has computed, for a next one of the same rows.

    with intervals_kept(layout, "table1"):
        ...                               # `bootstrap.mean_of` and the others compute what is new

A bootstrap takes milliseconds, and a report needs a thousand of them. The results are kept in the
cache folder (`spec.kept`) under a digest of their inputs: the rows of the cells, the column, and
the code.
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
Result = TypeVar("Result")
Plain = Any  # what JSON can hold


@dataclass
class _Kept:
    """The results of earlier reports, and those that this one needed, by digest of the inputs."""

    known: dict[str, Plain]
    used: dict[str, Plain] = field(default_factory=dict)
    digests: WeakKeyDictionary[CellTable, str] = field(default_factory=WeakKeyDictionary)

    def digest_of(self, inputs: object) -> str:
        """Return the digest of arguments; cells are digested by their rows."""
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
    """Within the block, use what an earlier report of this name has computed. At its end, keep what
    this one needed.
    """
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
    to_plain: Callable[[Result], Plain], from_plain: Callable[[Plain], Result]
) -> Callable[[Callable[P, Result | None]], Callable[P, Result | None]]:
    """Return a decorator for a function of cells, which then computes only what `intervals_kept`
    does not know. `to_plain` and `from_plain` convert its results to JSON values and back; None is
    kept as it is.
    """

    def decorate(compute: Callable[P, Result | None]) -> Callable[P, Result | None]:
        _computing.add(compute.__module__)

        @wraps(compute)
        def looked_up(*args: P.args, **kwargs: P.kwargs) -> Result | None:
            values = _current.get()
            if values is None:
                return compute(*args, **kwargs)
            named = sorted(kwargs.items())
            inputs = f"{compute.__name__} {values.digest_of(args)} {values.digest_of(named)}"
            key = hashlib.sha256(inputs.encode()).hexdigest()[:32]
            if key in values.known:
                plain = values.known[key]
                result = None if plain is None else from_plain(plain)
            else:
                result = compute(*args, **kwargs)
                plain = None if result is None else to_plain(result)
            values.used[key] = plain
            return result

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
