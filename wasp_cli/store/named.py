"""Which of several things a text names: by the beginning of a key, or by a label."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol, TypeVar

from wasp_cli.errors import UsageError, first

LEAST = 4  # characters of a key that name it, where they are unique
SHOWN = 12  # candidates that an error lists at most
_REPORTED = re.compile(r"(\S+) (.+) seed (\d+)")


class Named(Protocol):
    """A thing with a key and a label, if it has them."""

    @property
    def key(self) -> str | None:
        """Hexadecimal digits."""
        ...

    @property
    def label(self) -> str | None:
        """As a run prints it: `goal1 s0 wasp laggy=0.7`."""
        ...


Thing = TypeVar("Thing", bound=Named)


def matching(things: Iterable[Thing], text: str) -> list[Thing]:
    """Return the things whose key begins with a text; where there are none, those whose label it
    is.
    """
    every = list(things)
    line = one_line(text)
    by_key = [thing for thing in every if begins(thing.key or "", line)]
    if by_key:
        return by_key
    return [thing for thing in every if same_label(thing.label or "", line)]


def only(
    things: Sequence[Thing],
    text: str,
    what: str,
    about: Callable[[Thing], str] | None = None,
) -> Thing | None:
    """Return the one thing that a text names; None where there is none.

    Args:
        things: those that it names.
        text: as it was written.
        what: what they are, in the plural.
        about: returns what is known of a thing, for the list of several.

    Raises:
        UsageError: there are several; it lists them.
    """
    if not things:
        return None
    if len(things) == 1:
        return things[0]
    lines: list[str] = []
    for thing in things:
        parts = [thing.key, thing.label, "" if about is None else about(thing)]
        lines.append("  " + "  ".join(part for part in parts if part))
    title = f"'{one_line(text)}' names {len(things)} {what}:"
    raise UsageError(
        "\n".join([title, *first(lines, SHOWN)]),
        "give the first characters of one of these keys, or the run with --run",
    )


def same_label(label: str, text: str) -> bool:
    """Return whether a text is a label, as a run or a report prints it, in capitals or not."""
    # Reports print `goal1 wasp laggy=0.7 seed 0` for the cell that runs call `goal1 s0 wasp
    # laggy=0.7`.
    reported = _REPORTED.fullmatch(text)
    if reported is not None:
        text = f"{reported[1]} s{reported[3]} {reported[2]}"
    return label.casefold() == text.casefold()


def begins(key: str, text: str) -> bool:
    """Return whether a text is long enough to name a key, and is the beginning of this one."""
    return len(text) >= LEAST and key.startswith(text.lower())


def one_line(text: str) -> str:
    """Return a text with every white space replaced by a single blank."""
    return " ".join(text.split())
