"""Closing environments: by whoever is done with them, when nobody holds them any more, and all of
them at the end of a node, a command, or the program.

`close()` is code of others. What it raises is printed as a warning, and a call that does not return
is left after a time.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import sys
import weakref
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TextIO, runtime_checkable

from wasp_cli.errors import described
from wasp_cli.tasks.foreign.limit import LimitReached, left_after, process_ended_after
from wasp_cli.tasks.foreign.started import marking

CLOSE_SECONDS = 10.0  # that an environment may take to close
AGAIN_SECONDS = 1.0  # the same, after one of its name has taken too long
HINT = (
    "its close() has to end what it has started, and to return: process.kill() ends what does not "
    "listen to process.terminate()"
)


class Closable(Protocol):
    """An environment."""

    def close(self) -> Any:
        """Free what it holds."""
        ...


@runtime_checkable
class Elsewhere(Protocol):
    """Environments in other processes, which keep the time that they may take there."""

    def close_elsewhere(self) -> list[str]:
        """Close them, and return what went wrong."""
        ...


@dataclass(eq=False)
class _Opened:
    """Environments that are open."""

    name: str
    owner: weakref.ref[Any]  # they are closed when nobody holds it any more
    envs: list[Any]


@dataclass(eq=False)
class Scope:
    """A part of a program at whose end every environment is closed."""

    last_words: Path | TextIO | None
    """Where a process writes what it was doing before it ends itself, because an environment closes
    in native code that does not return. None: it does not end itself."""
    troubles: list[str] = field(default_factory=list)
    """What went wrong in closing, by environment."""
    quiet: bool = False
    """Whether nothing is printed: whoever opened the scope reads `troubles`."""


_opened: list[_Opened] = []
_scopes: list[Scope] = []
_slow: set[str] = set()  # names of environments of which one did not close in time


@contextmanager
def environments(
    last_words: Path | TextIO | None = None, *, quiet: bool = False
) -> Iterator[Scope]:
    """Close every environment that is open at the end of the block, also where that raises.

    Processes that environments start in the block end with this one at the latest. `last_words` and
    `quiet` are those of `Scope`; a `last_words` of None is that of the scope around the block.
    """
    if last_words is None and _scopes:
        last_words = _scopes[-1].last_words
    scope = Scope(last_words, quiet=quiet)
    with marking():
        _scopes.append(scope)
        try:
            yield scope
        finally:
            try:
                close_all()
            finally:
                _scopes.remove(scope)


def opened(owner: object, name: str) -> list[Any]:
    """Return a list for the environments of `owner`: what is in it is closed when nobody holds the
    owner any more, and others are opened, or at the end.
    """
    close_forgotten()
    envs: list[Any] = []
    _opened.append(_Opened(name, weakref.ref(owner), envs))
    return envs


def close_owned(owner: object) -> None:
    """Close the environments of `owner`."""
    _close_some([entry for entry in _opened if entry.owner() is owner])


def close_forgotten() -> None:
    """Close environments whose owner nobody holds.

    Not when the owner goes: that may be in any thread, and between any two instructions.
    """
    if _opened:
        gc.collect()  # an owner may be in a circle
    _close_some([entry for entry in _opened if entry.owner() is None])


def close_all() -> None:
    """Close every environment that is open."""
    _close_some(list(_opened))


def _close_some(chosen: list[_Opened]) -> None:
    for entry in chosen:
        while entry.envs:
            env = entry.envs.pop()
            if not isinstance(env, Elsewhere):
                close(entry.name, env)
                continue
            for trouble in env.close_elsewhere():
                _say(trouble)
        _opened.remove(entry)


def close(name: str, env: Closable) -> None:
    """Close one environment. What goes wrong is printed to stderr, and noted in the scope."""
    seconds = AGAIN_SECONDS if name in _slow else CLOSE_SECONDS
    try:
        # what it prints must not get between the lines of JSON on stdout
        with contextlib.redirect_stdout(sys.stderr), _ended_over(2 * seconds), left_after(seconds):
            env.close()
    except LimitReached:
        _slow.add(name)
        _say(f"environment '{name}' did not close within {CLOSE_SECONDS:g} s")
    except (Exception, SystemExit) as error:
        _say(f"environment '{name}' failed to close: {described(error)}")


@contextmanager
def _ended_over(seconds: float) -> Iterator[None]:
    """End the process where native code does not return from the block, if the scope says so."""
    last_words = _scopes[-1].last_words if _scopes else None
    with ExitStack() as stack:
        if isinstance(last_words, Path):
            stack.callback(last_words.unlink, missing_ok=True)
            last_words = stack.enter_context(_written(last_words))
        if last_words is not None:
            stack.enter_context(process_ended_after(seconds, last_words))
        yield


@contextmanager
def _written(path: Path) -> Iterator[TextIO | None]:
    """A file to write; None where the disk is full, which must not keep what closes from that."""
    with ExitStack() as stack:
        file = None
        with contextlib.suppress(OSError):
            file = stack.enter_context(path.open("w", encoding="utf-8"))
        yield file


def _say(trouble: str) -> None:
    """Print what went wrong, once in a scope, and note it there."""
    troubles = _scopes[-1].troubles if _scopes else []
    if trouble in troubles:
        return
    troubles.append(trouble)
    if _scopes and _scopes[-1].quiet:
        return
    print(f"warning: {trouble}\n  {HINT}", file=sys.stderr)


atexit.register(close_all)
os.register_at_fork(after_in_child=_opened.clear)  # they are the parent's
