"""The expected errors of `wasp`, each with its exit code on the command line: 1, unless a class
sets another one.

An expected error is printed as one message and a hint, without a traceback.
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
    """No figure can be drawn, since matplotlib cannot be imported."""


class NotAccepted(WaspError):
    """A measurement does not meet the rule that it is checked against."""


class UsageError(WaspError):
    """A command-line argument is wrong."""

    exit_code = 2


class UnknownName(UsageError):
    """A name that is not known. The hint suggests close ones; if none is close it is `otherwise`,
    or all known names.
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
        self.kind = kind
        self.name = name
        self.known = known
        self._otherwise = otherwise

    def __reduce__(self) -> tuple[type[UnknownName], tuple[str, str, list[str], str, str | None]]:  # type: ignore[override]
        return type(self), (self.kind, self.name, self.known, self.message, self._otherwise)


class UnknownOption(UsageError, TypeError):
    """An environment is made with an option that it does not have. It is also a `TypeError`, after
    which callers retry without the option.

    `gymnasium.make` raises it again from its text alone, so the message has everything.
    """


class SpecError(WaspError):
    """A spec cannot be read or is invalid. `message` has every problem with its position."""

    exit_code = 3


class Interrupted(WaspError):
    """Ctrl-C or SIGTERM ended a run; what was finished is kept."""

    exit_code = 130


# characters of a name that is compared with others: the time grows with the product of both lengths
LONGEST_NAME = 300


def refusal(error: OSError) -> WaspError:
    """Return an OSError as an expected error: the reason and the file, with a hint."""
    reason = (error.strerror or str(error) or type(error).__name__).lower()
    hint = "wasp --debug COMMAND shows where"
    if "no usable temporary directory" in reason:  # the words of Python's tempfile
        hint = "set TMPDIR to a folder that can be written"
    message = reason
    if error.filename is not None:
        message = f"'{error.filename}': {reason}"
    return WaspError(message, hint)


def first(lines: Sequence[str], most: int) -> list[str]:
    """Return the first of some lines, and how many more there are."""
    if len(lines) <= most:
        return list(lines)
    return [*lines[:most], f"  and {len(lines) - most} more"]


def did_you_mean(name: str, known: Iterable[str], otherwise: str | None = None) -> str:
    """Return a hint with the closest known names; if none is close, `otherwise`, or all of them.

    Capitals do not count, and the namespace of `space/Name` may be missing.
    """
    known = list(known)
    likeness = {other: closeness(name, [other]) for other in known}
    best = max(likeness.values(), default=0.0)
    close = [f"'{other}'" for other in known if likeness[other] >= max(0.6, best - 0.03)][:4]
    if len(close) == 1:
        return f"did you mean {close[0]}?"
    if close:
        return f"did you mean {', '.join(close[:-1])} or {close[-1]}?"
    if len(name) > LONGEST_NAME:
        return f"a name has at most {LONGEST_NAME} characters, this one has {len(name)}"
    return otherwise or "known: " + ", ".join(known)


def closeness(name: str, known: Iterable[str]) -> float:
    """Return how close the closest of some names is, from 0 to 1, with or without namespaces."""
    pairs = [
        (name.lower(), other.lower())
        for other in known
        if max(len(name), len(other)) <= LONGEST_NAME
    ]
    pairs += [(one.rpartition("/")[2], other.rpartition("/")[2]) for one, other in pairs]
    return max((difflib.SequenceMatcher(None, *pair).ratio() for pair in pairs), default=0.0)


def described(error: BaseException) -> str:
    """Return type and message of an error on one line."""
    text = " ".join(str(error).split())
    if not text:
        return type(error).__name__
    return f"{type(error).__name__}: {text}"
