"""From a place in a document to a line and a column of its file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ruamel.yaml.comments import CommentedMap, CommentedSeq

Loc = tuple[str | int, ...]
KEY = "[key]"
"""How pydantic ends the place of a key (not of its value)."""


@dataclass(frozen=True)
class Position:
    """A place in a text, counted from 1 as editors do."""

    line: int
    column: int


START = Position(1, 1)


def locate(document: Any, loc: Sequence[str | int], *, at_key: bool = False) -> tuple[Position, int]:
    """The position of what pydantic calls `loc`, and how many parts of `loc` the document really has.

    pydantic's places also hold the tags of unions, which no file has, and fields that the file leaves out: a tag is skipped,
    and a missing field is reported at the mapping it is missing from. A key that came through a merge (`<<`) has no position
    of its own; its mapping stands for it.
    """
    wants_key = at_key or (bool(loc) and loc[-1] == KEY)
    position, node, depth = START, document, 0
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
        position = _position(node, part, key=(wants_key and last) or child is None) or position
        node, depth = child, index + 1
    if isinstance(node, CommentedMap | CommentedSeq) and depth < len(loc) and depth:
        # Something is missing inside: the key of the section says more than its first entry.
        parent, name = _parent(document, loc[:depth])
        position = _position(parent, name, key=True) or position
    return position, depth


_ABSENT = object()


def _child(node: Any, part: str | int) -> Any:
    if isinstance(node, CommentedMap):
        return node[part] if part in node else _numeric_key(node, part)
    if isinstance(node, CommentedSeq) and isinstance(part, int) and 0 <= part < len(node):
        return node[part]
    return _ABSENT


def _numeric_key(node: CommentedMap, part: str | int) -> Any:
    """A key written as a number reaches pydantic as a string."""
    key = _written(node, part)
    return _ABSENT if key is _ABSENT else node[key]


def _written(node: CommentedMap, part: str | int) -> Any:
    return next((key for key in node if key == part or str(key) == str(part)), _ABSENT)


def _position(node: Any, part: str | int, *, key: bool) -> Position | None:
    try:
        if isinstance(node, CommentedMap):
            line, column = (node.lc.key if key else node.lc.value)(_written(node, part))
        else:
            line, column = node.lc.item(part)
    except (KeyError, TypeError, AttributeError):  # a merged key, or a collection without positions
        return None
    return Position(line + 1, column + 1)


def _parent(document: Any, loc: Sequence[str | int]) -> tuple[Any, str | int]:
    node = document
    for part in loc[:-1]:
        child = _child(node, part)
        node = node if child is _ABSENT else child
    return node, loc[-1]
