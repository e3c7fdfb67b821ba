"""Problems of spec files, each with its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from wasp_cli.errors import SpecError

Loc = tuple[str | int, ...]
KEY = "[key]"
"""How pydantic ends the place of a key (not of its value)."""


@dataclass(frozen=True)
class Position:
    """A place in a text, counted from 1 as editors do."""

    line: int
    column: int


START = Position(1, 1)


_WIDTH = 110
"""Longest excerpt of a line."""


@dataclass(frozen=True)
class Problem:
    """One mistake: its place, what is wrong, how to fix it, and the line it stands in."""

    source: str
    """The file as the user named it, or the option that brought the value."""
    position: Position | None
    """None for a value that came from the command line."""
    message: str
    hint: str | None = None
    line: str | None = None
    """Text of the line at `position`."""

    @property
    def place(self) -> str:
        """`file:line:column`, which editors turn into a link."""
        return self.source if self.position is None else f"{self.source}:{self.position.line}:{self.position.column}"

    def __str__(self) -> str:
        parts = [f"{self.place}: {_printable(self.message)}", *self._excerpt()]
        if self.hint:
            parts.append(f"    {_printable(self.hint)}")
        return "\n".join(parts)

    def as_json(self) -> dict[str, Any]:
        """Return this for machines."""
        line, column = (None, None) if self.position is None else (self.position.line, self.position.column)
        return {"file": self.source, "line": line, "column": column, "message": self.message, "hint": self.hint, "excerpt": self.line}

    def _excerpt(self) -> list[str]:
        if self.position is None or self.line is None:
            return []
        number, column = f"{self.position.line:>5} | ", self.position.column
        # A caret far to the right is of no use: show the part of the line around it.
        start = 0 if column < _WIDTH else column - _WIDTH // 2
        shown = self.line[start : start + _WIDTH]
        # Tabs stay tabs, so that the caret stands under its character at any tab width.
        before = "".join("\t" if character == "\t" else " " for character in shown[: column - 1 - start])
        return [number + shown, " " * (len(number) - 2) + "| " + before + "^"]


def _printable(text: str) -> str:
    """A text without what would steer a terminal: escapes in a YAML string can name any character."""
    return "".join(character if character.isprintable() or character == "\n" else repr(character)[1:-1] for character in text)


class InvalidSpec(SpecError):
    """A spec with problems, all of them: file by file as they are first named, each in its order, then those of options."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        files = list(dict.fromkeys(problem.source for problem in problems if problem.position is not None))
        self.problems = tuple(sorted(problems, key=lambda problem: _order(problem, files)))
        super().__init__("\n".join(str(problem) for problem in self.problems))

    def __reduce__(self) -> tuple[type[InvalidSpec], tuple[tuple[Problem, ...]]]:  # type: ignore[override]
        return type(self), (self.problems,)


def _order(problem: Problem, files: Sequence[str]) -> tuple[int, int, int]:
    position = problem.position
    return (len(files), 0, 0) if position is None else (files.index(problem.source), position.line, position.column)
