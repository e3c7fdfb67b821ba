"""A YAML file to a document with positions, and to the plain values in it."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedOrderedMap, CommentedSeq
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.reader import ReaderError

from wasp_cli.spec.problem import InvalidSpec, Problem
from wasp_cli.spec.where import START, Loc, Position, locate

MAX_BYTES = 1_000_000
MAX_VALUES = 100_000
"""Aliases of aliases can stand for more values than any memory holds."""


@dataclass(frozen=True)
class Source:
    """The text of a spec and its document."""

    name: str
    text: str
    document: Any

    def problem(self, loc: Loc, message: str, hint: str | None = None, *, at_key: bool = False) -> Problem:
        """A problem at a place of the document."""
        position, _ = locate(self.document, loc, at_key=at_key)
        return self.problem_at(position, message, hint)

    def problem_at(self, position: Position, message: str, hint: str | None = None) -> Problem:
        """A problem at a position of the text."""
        lines = self.text.splitlines()
        line = lines[position.line - 1] if 0 < position.line <= len(lines) else None
        return Problem(self.name, position, message, hint, line)


def read(path: Path) -> Source:
    """Read the YAML mapping in a file.

    Raises:
        InvalidSpec: no such file, not text, not YAML, or not a mapping.
    """
    return parse(_text(path), str(path))


def parse(text: str, name: str) -> Source:
    """Parse a YAML mapping; `name` stands for the file in messages."""
    source = Source(name, text, None)
    reader = YAML(typ="rt")
    try:
        document = reader.load(text)
    except MarkedYAMLError as error:
        raise InvalidSpec([_yaml_problem(source, error)]) from error
    except ReaderError as error:
        position = _position_of(text, error.position or 0)
        raise InvalidSpec([source.problem_at(position, f"not a text file: {error.reason}")]) from error
    except RecursionError as error:
        raise InvalidSpec([source.problem_at(START, "nested too deeply")]) from error
    except (YAMLError, ValueError, TypeError, KeyError, AttributeError, IndexError, AssertionError, NotImplementedError) as error:
        # ruamel builds dates and numbers while it loads, and lets their errors through without a position.
        raise InvalidSpec([source.problem_at(START, f"not valid YAML: {error}")]) from error
    if not isinstance(document, CommentedMap):
        what = "the file is empty" if document is None else f"a spec is a mapping of keys to values, not {_kind(document)}"
        raise InvalidSpec([source.problem_at(START, what, "specs/quickstart.yaml is an example")])
    return Source(name, text, document)


def _text(path: Path) -> str:
    def refuse(message: str, hint: str | None = None) -> InvalidSpec:
        return InvalidSpec([Problem(str(path), START, message, hint)])

    try:
        if path.is_dir():
            raise refuse("is a folder, not a spec file", _specs_in(path))
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise refuse("no such file", _specs_in(path.parent)) from error
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        raise refuse(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > MAX_BYTES:
        raise refuse(f"is larger than {MAX_BYTES:,} bytes; this is no spec")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = data[: error.start].decode("utf-8", errors="replace")
        position = _position_of(before, len(before))
        raise InvalidSpec([Problem(str(path), position, f"not a text file: byte 0x{data[error.start]:02x} is not UTF-8")]) from error


def _specs_in(folder: Path) -> str | None:
    try:
        found = sorted(str(path) for path in folder.glob("*.yaml"))
    except OSError:
        return None
    return "here are: " + ", ".join(found[:8]) if found else None


def _position_of(text: str, index: int) -> Position:
    before = text[:index]
    return Position(before.count("\n") + 1, index - (before.rfind("\n") + 1) + 1)


def _yaml_problem(source: Source, error: MarkedYAMLError) -> Problem:
    mark = error.problem_mark or error.context_mark
    position = Position(mark.line + 1, mark.column + 1) if mark is not None else START
    what = (error.problem or error.context or "not valid YAML").strip()
    if what.startswith("found duplicate key"):
        what = what.split(" with value")[0].replace('"', "'")
        return source.problem_at(position, what, "each key may stand once; which of the values is meant?")
    hint = "indent with spaces; a tab is not allowed there" if "\\t" in what else None
    return source.problem_at(position, f"not valid YAML: {what}", hint)


def plain(source: Source) -> tuple[dict[str, Any], list[Problem]]:
    """The document as JSON values, and what in it is none."""
    problems: list[Problem] = []
    budget = iter(range(MAX_VALUES))
    values = _plain(source, source.document, (), problems, budget, ())
    return values, problems


def _plain(source: Source, node: Any, loc: Loc, problems: list[Problem], budget: Iterator[int], above: tuple[int, ...]) -> Any:
    if next(budget, None) is None:
        raise InvalidSpec([source.problem_at(START, f"more than {MAX_VALUES:,} values; aliases of aliases?")])
    if id(node) in above:
        problems.append(source.problem(loc, "contains itself through an alias"))
        return None
    above = (*above, id(node))
    if isinstance(node, CommentedMap) and not isinstance(node, CommentedOrderedMap):
        result: dict[str, Any] = {}
        for key, value in node.items():
            if isinstance(key, bool) or not isinstance(key, str | int | float) or str(key) in result:
                place = (*loc, key) if isinstance(key, str | int) else loc
                problems.append(source.problem(place, f"a key should be a plain word, not {key!r}", at_key=True))
                continue
            result[str(key)] = _plain(source, value, (*loc, str(key)), problems, budget, above)
        return result
    if isinstance(node, CommentedSeq):
        return [_plain(source, value, (*loc, index), problems, budget, above) for index, value in enumerate(node)]
    return _scalar(source, node, loc, problems)


def _scalar(source: Source, node: Any, loc: Loc, problems: list[Problem]) -> Any:
    if node is None or isinstance(node, bool):
        return node
    if type(node).__name__ == "ScalarBoolean":  # an anchored true is an int to ruamel
        return bool(node)
    if isinstance(node, int):
        return int(node)
    if isinstance(node, float):
        number = float(node)
        if not math.isfinite(number):
            problems.append(source.problem(loc, f"should be a finite number, not {number}"))
            return None
        # 1e6 is a float in YAML and a count to people.
        return int(number) if number.is_integer() and abs(number) < 2**53 else number
    if isinstance(node, str):
        return str(node)
    hint = "put it in quotes" if isinstance(node, datetime.date) else "specs hold plain numbers, words, lists and mappings"
    problems.append(source.problem(loc, f"{_kind(node)} is no value of a spec", hint))
    return None


_KINDS = {
    "CommentedSeq": "a list",
    "CommentedSet": "a set",
    "CommentedOrderedMap": "an ordered mapping",
    "TaggedScalar": "a value with a tag",
    "bytes": "binary data",
}


def _kind(node: Any) -> str:
    if isinstance(node, str):
        return "a single word" if " " not in node and "\n" not in node else "plain text"
    if isinstance(node, datetime.date):  # ruamel's timestamps too
        return "a date"
    name = type(node).__name__
    return _KINDS.get(name, f"a {name}")
