"""Where things stand in spec files, and the problems that are found there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ruamel.yaml.comments import CommentedMap, CommentedSeq

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
LARGEST = 2**63
"""Numbers of a spec lie below it."""


@dataclass(frozen=True)
class Place:
    """Where a document has what pydantic calls a `loc`."""

    position: Position
    depth: int
    """How many parts of the `loc` the document really has."""


def locate(document: Any, loc: Sequence[str | int], *, at_key: bool = False) -> Place:
    """Return the place of what pydantic calls `loc`.

    pydantic's places also hold the tags of unions, which no file has, and fields that the file leaves out: a tag is skipped,
    and a missing field is reported at the mapping it is missing from.
    """
    wants_key = at_key or (bool(loc) and loc[-1] == KEY)
    position, node, depth = START, document, 0
    parent = document
    for index, part in enumerate(loc):
        if part == KEY:
            break
        child = _child(node, part)
        if child is _ABSENT:
            following = loc[index + 1] if index + 1 < len(loc) else KEY
            if depth and _child(node, following) is not _ABSENT:
                continue
            break
        last = index == len(loc) - 1 or loc[index + 1] == KEY
        parent = node
        position = _position(parent, part, key=(wants_key and last) or child is None) or position
        node, depth = child, index + 1
    if isinstance(node, CommentedMap | CommentedSeq) and depth < len(loc) and depth:
        # Something is missing inside: the key of the section says more than its first entry.
        position = _position(parent, loc[depth - 1], key=True) or position
    return Place(position, depth)


def key_position(node: CommentedMap, key: Any) -> Position | None:
    """Return where a key is written, whatever it is; None where ruamel does not say."""
    return _position(node, key, key=True)


_ABSENT = object()


def _child(node: Any, part: str | int) -> Any:
    if isinstance(node, CommentedMap):
        key = _written(node, part)
        return _ABSENT if key is _ABSENT else node[key]
    if isinstance(node, CommentedSeq) and isinstance(part, int) and 0 <= part < len(node):
        return node[part]
    return _ABSENT


def _written(node: CommentedMap, part: Any) -> Any:
    """A key as the file has it: one written as a number reaches pydantic as a string."""
    if part in node:
        return part
    # Python refuses to write very large numbers; they are no keys of a spec.
    numbers = (key for key in node if isinstance(key, int | float) and abs(key) < LARGEST)
    return next((key for key in numbers if str(key) == str(part)), _ABSENT)


def _position(node: Any, part: Any, *, key: bool) -> Position | None:
    try:
        if isinstance(node, CommentedMap):
            line, column = (node.lc.key if key else node.lc.value)(_written(node, part))
        else:
            line, column = node.lc.item(part)
    except (KeyError, TypeError, AttributeError):  # a collection without positions
        return None
    return Position(line + 1, column + 1)


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
