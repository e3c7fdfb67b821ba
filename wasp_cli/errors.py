"""The expected errors of `wasp`, each with the exit code that the command line returns for it: 1,
where it names no other.

An expected error prints as one message and a hint, never as a traceback.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from typing import ClassVar


class WaspError(Exception):
    """Base of every expected error: `message` says what and where, `hint` how to fix it."""

    exit_code: ClassVar[int] = 1

    def __init__(self, message: str, hint: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __reduce__(self) -> tuple[type[WaspError], tuple[str, str | None]]:
        return type(self), (self.message, self.hint)


class CellsFailed(WaspError):
    """A run ended, and some of its nodes failed or were blocked by a failed one."""


class StoreError(WaspError):
    """The results folder cannot be read or written."""


class ArtifactError(WaspError):
    """An artifact is damaged, or does not fit the component that reads it."""


class SourceChanged(WaspError):
    """The code changed while a run was going, so that a result would not belong to its key."""


class TimeLimitExceeded(WaspError):
    """A node took longer than the run gave it."""


class TaskError(WaspError):
    """A task was driven wrongly: a non-finite or misshapen action, a step after the end."""


class EnvironmentDied(TaskError):
    """The process in which environments of a task are stepped has ended."""


class TrainingError(WaspError):
    """A learning stage cannot go on: a non-finite loss, or data without what it needs."""


class DrawingError(WaspError):
    """No figure can be drawn, since matplotlib does not begin."""


class NotAccepted(WaspError):
    """What was measured does not keep the rule that it is held against."""


class UsageError(WaspError):
    """A command-line argument is wrong."""

    exit_code = 2


class UnknownName(UsageError):
    """A name that no registry knows; the hint suggests close ones, or is `otherwise` (all that
    is known) where none is close.
    """

    def __init__(
        self,
        kind: str,
        name: str,
        known: Iterable[str],
        message: str | None = None,
        otherwise: str | None = None,
    ) -> None:
        known = sorted(known)
        super().__init__(
            message or f"unknown {kind} '{name}'", did_you_mean(name, known, otherwise)
        )
        self.kind, self.name, self.known, self._otherwise = kind, name, known, otherwise

    def __reduce__(self) -> tuple[type[UnknownName], tuple[str, str, list[str], str, str | None]]:  # type: ignore[override]
        return type(self), (self.kind, self.name, self.known, self.message, self._otherwise)


class UnknownOption(UsageError, TypeError):
    """An environment is made with an option that it does not have: a `TypeError` in Python's words,
    on which others retry without it.

    `gymnasium.make` raises it anew from its text alone, so the message says all of it.
    """


class SpecError(WaspError):
    """A spec file does not read or does not validate. `message` holds every problem with its
    position.
    """

    exit_code = 3


class Interrupted(WaspError):
    """Ctrl-C or SIGTERM ended a run; what was finished is kept."""

    exit_code = 130


# characters of a name that is compared with others, which takes as long as both are, multiplied
LONGEST_NAME = 300


def refusal(error: OSError) -> WaspError:
    reason = (error.strerror or str(error) or type(error).__name__).lower()
    hint = "wasp --debug COMMAND shows where"
    if "no usable temporary directory" in reason:  # the words of Python's tempfile
        hint = "set TMPDIR to a folder that can be written"
    return WaspError(
        reason if error.filename is None else f"'{error.filename}': {reason}",
        hint,
    )


def first(lines: Sequence[str], most: int) -> list[str]:
    """Return the first of some lines, and how many more there are."""
    return [*lines[:most], *([f"  and {len(lines) - most} more"] if len(lines) > most else [])]


def did_you_mean(name: str, known: Iterable[str], otherwise: str | None = None) -> str:
    """Write a hint that names the closest known names; when none is close, `otherwise`, or all of
    them.

    Capitals do not count, and of `space/Name` the namespace may be missing.
    """
    known = list(known)
    likeness = {other: closeness(name, [other]) for other in known}
    best = max(likeness.values(), default=0.0)
    close = [f"'{other}'" for other in known if likeness[other] >= max(0.6, best - 0.03)][:4]
    if close:
        return "did you mean " + " or ".join(filter(None, (", ".join(close[:-1]), close[-1]))) + "?"
    if len(name) > LONGEST_NAME:
        return f"a name has at most {LONGEST_NAME} characters, this one has {len(name)}"
    return otherwise or "known: " + ", ".join(known)


def closeness(name: str, known: Iterable[str]) -> float:
    """Measure how close the closest of some names is, from 0 to 1, with namespaces or without
    them.
    """
    pairs = [
        (name.lower(), other.lower())
        for other in known
        if max(len(name), len(other)) <= LONGEST_NAME
    ]
    pairs += [(one.rpartition("/")[2], other.rpartition("/")[2]) for one, other in pairs]
    return max((difflib.SequenceMatcher(None, *pair).ratio() for pair in pairs), default=0.0)


def described(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
