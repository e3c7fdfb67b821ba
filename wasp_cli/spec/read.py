"""From the text of a spec file to plain values.

What YAML knows beyond JSON (dates, anchors, merges, tags) is a problem with a place: `extends` is the one way to share sections.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.tokens import AliasToken, AnchorToken, ScalarToken, TagToken

from wasp_cli.errors import did_you_mean
from wasp_cli.spec.places import KEY, LARGEST, START, InvalidSpec, Loc, Position, Problem, key_position, locate
from wasp_cli.spec.shipped import shipped_names

MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class Source:
    """The text of a spec and its document."""

    name: str
    text: str
    document: Any

    def problem(self, loc: Loc, message: str, hint: str | None = None, *, at_key: bool = False) -> Problem:
        """Return a problem at a place."""
        return self.problem_at(locate(self.document, loc, at_key=at_key).position, message, hint)

    def problem_at(self, position: Position, message: str, hint: str | None = None) -> Problem:
        """Return a problem at a position of the text."""
        lines = lines_of(self.text)
        line = lines[position.line - 1] if 0 < position.line <= len(lines) else None
        return Problem(self.name, position, message, hint, line or None)


def read(path: Path) -> Source:
    """Read the YAML mapping in a file.

    Raises:
        InvalidSpec: no such file, not text, not YAML, or not a mapping.
    """
    return parse(_text(path), str(path))


def parse(text: str, name: str) -> Source:
    """Parse a YAML mapping; `name` stands for the file in messages."""
    source = Source(name, text, None)
    document = _document(source)
    if not isinstance(document, CommentedMap):
        what = "the file is empty" if document is None else f"a spec is a mapping of keys to values, not {kind_of(document)}"
        raise InvalidSpec([source.problem_at(START, what, "specs/quickstart.yaml is an example")])
    return Source(name, text, document)


def _document(source: Source) -> Any:
    text = source.text
    try:
        _refuse_sharing(source)
        return YAML(typ="rt").load(text)
    except MarkedYAMLError as error:
        raise InvalidSpec([_yaml_problem(source, error)]) from error
    except ReaderError as error:
        position = _position_of(text, error.position or 0)
        raise InvalidSpec([source.problem_at(position, f"not a text file: {error.reason}")]) from error
    except RecursionError as error:
        raise InvalidSpec([source.problem_at(START, "nested too deeply")]) from error
    except (YAMLError, ValueError, TypeError, KeyError, AttributeError, IndexError, AssertionError, NotImplementedError) as error:
        # ruamel builds dates and numbers while it loads, and lets their errors through without a position.
        position, reason = unplaced(text) or (START, str(error))
        raise InvalidSpec([source.problem_at(position, f"not valid YAML: {reason}")]) from error


SHARING = {AnchorToken: "an anchor (&)", AliasToken: "an alias (*)", TagToken: "a tag (!)"}
MERGE = "<<"


def _refuse_sharing(source: Source) -> None:
    """See that a text has no anchors, aliases, merges and tags: what is meant at one place should be read there."""
    for token in YAML(typ="rt").scan(source.text):
        what = SHARING.get(type(token))
        if isinstance(token, ScalarToken) and token.plain and token.value == MERGE:
            what = f"a merge ({MERGE})"
        if what is not None:
            hint = "write the value where it is used; whole sections are shared with `extends`"
            raise InvalidSpec([source.problem_at(_at(token), f"{what} is no part of a spec", hint)])


def _text(path: Path) -> str:
    def refuse(message: str, hint: str | None = None) -> InvalidSpec:
        return InvalidSpec([Problem(str(path), START, message, hint)])

    try:
        if path.is_dir():
            raise refuse("is a folder, not a spec file", inside(path))
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise refuse("no such file", meant(path)) from error
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        raise refuse(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > MAX_BYTES:
        raise refuse(f"is larger than {MAX_BYTES:,} bytes, too large for a spec")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = data[: error.start].decode("utf-8", errors="replace")
        position = _position_of(before, len(before))
        raise InvalidSpec([Problem(str(path), position, f"not a text file: byte 0x{data[error.start]:02x} is not UTF-8")]) from error


def meant(path: Path) -> str:
    """Return a hint for those who look for a spec that is not there: what is nearly called so, or what there is."""
    # Compared without the ending, which makes all of them alike.
    files = {file.stem: file.name for file in _specs_in(path.parent)}
    names = shipped_names()
    shown = {name: name for name in names} | files
    there = "; ".join(filter(None, (inside(path.parent), f"by name there are: {', '.join(names)}")))
    hint = did_you_mean(path.stem, list(shown), otherwise=there)
    return hint if hint == there else re.sub(r"'([^']*)'", lambda match: f"'{shown.get(match[1], match[1])}'", hint)


def inside(folder: Path) -> str | None:
    """Return a hint that names the first specs in a folder; None where there are none."""
    files = _specs_in(folder)[:8]
    return "here are: " + ", ".join(map(str, files)) if files else None


def _specs_in(folder: Path) -> list[Path]:
    try:
        return sorted(folder.glob("*.yaml"))
    except OSError:
        return []


def _position_of(text: str, index: int) -> Position:
    lines = lines_of(text[:index])
    return Position(len(lines), len(lines[-1]) + 1)


def lines_of(text: str) -> list[str]:
    """Return the lines of a text as YAML 1.2 and editors count them; Python's `splitlines` also ends them at rarer characters."""
    return re.split(r"\r\n|\r|\n", text)


def _yaml_problem(source: Source, error: MarkedYAMLError) -> Problem:
    mark = error.problem_mark or error.context_mark
    position = Position(mark.line + 1, mark.column + 1) if mark is not None else START
    what = (error.problem or error.context or "not valid YAML").strip()
    if what.startswith("found duplicate key"):
        what = what.split(" with value")[0].replace('"', "'")
        return source.problem_at(position, what, "each key may stand once; which of the values is meant?")
    hint = "indent with spaces; a tab is not allowed there" if "\\t" in what else None
    return source.problem_at(position, f"not valid YAML: {what}", hint)


_KINDS = {
    "CommentedMap": "a mapping",
    "CommentedKeyMap": "a mapping",
    "CommentedSeq": "a list",
    "CommentedKeySeq": "a list",
}


def kind_of(node: Any) -> str:
    """Return what people call a value of a YAML document."""
    if isinstance(node, str):
        return "a single word" if " " not in node and "\n" not in node else "plain text"
    if isinstance(node, datetime.date):  # ruamel's timestamps too
        return "a date"
    name = type(node).__name__
    return _KINDS.get(name, f"a {name}")


def dotted(loc: Loc) -> str:
    """Return a place as `--set` names it."""
    return ".".join(str(part) for part in loc if part != KEY)


_TAG = "tag:yaml.org,2002:"
_NO_SCALAR = {"int": "not an integer", "float": "not a number", "timestamp": "not a valid date", "bool": "not a boolean"}
"""By tag: what is said of a scalar that cannot be built. Those of other tags always can, or have an error with a position."""
_LONGEST = 40
Fault = tuple[Position, str]


def unplaced(text: str) -> Fault | None:
    """Return the place and the reason of the first value in a text that cannot be built, or None when every one can."""
    reader = YAML(typ="rt")
    with suppress(RecursionError):
        return next(_faults(reader, reader.compose(text)), None)
    return None


def _faults(reader: YAML, node: Any) -> Iterator[Fault]:
    if isinstance(node, ScalarNode):
        tag = str(node.tag).removeprefix(_TAG)
        if tag in _NO_SCALAR:
            try:
                reader.constructor.construct_object(node)
            except Exception:  # whatever Python says of a text that is no number
                value = node.value if len(node.value) <= _LONGEST else node.value[: _LONGEST - 3] + "..."
                yield _at(node), f"'{value}' is {_NO_SCALAR[tag]}"
    elif isinstance(node, SequenceNode | MappingNode):
        for below in node.value:
            for each in below if isinstance(below, tuple) else (below,):
                yield from _faults(reader, each)


def _at(node: Any) -> Position:
    return Position(node.start_mark.line + 1, node.start_mark.column + 1)


MAX_DEPTH = 32
"""Of lists and mappings in each other; JSON readers give up at some depth without a place."""


def plain(source: Source) -> tuple[dict[str, Any], list[Problem]]:
    """Return the document as JSON values, and what in it is none.

    Raises:
        InvalidSpec: it has too many levels for anything to be said of them.
    """
    reader = _Reader(source)
    values: dict[str, Any] = reader.value(source.document, ())
    return values, reader.problems


@dataclass
class _Reader:
    source: Source
    problems: list[Problem] = field(default_factory=list)

    def value(self, node: Any, loc: Loc) -> Any:
        if len(loc) > MAX_DEPTH:
            raise InvalidSpec([self.source.problem(loc, "nested too deeply")])
        if isinstance(node, CommentedMap):
            return self.mapping(node, loc)
        if isinstance(node, CommentedSeq):
            return [self.value(value, (*loc, index)) for index, value in enumerate(node)]
        return self.scalar(node, loc)

    def mapping(self, node: CommentedMap, loc: Loc) -> dict[str, Any]:
        result: dict[str, Any] = {}
        for key, value in node.items():
            reason = _no_key(key)
            if reason is None and str(key) in result:
                reason = f"duplicate key '{key}'"  # 1 and '1'
            if reason is not None:
                position = key_position(node, key)
                self.problems.append(
                    self.source.problem(loc, reason, at_key=True) if position is None else self.source.problem_at(position, reason)
                )
                continue
            result[str(key)] = self.value(value, (*loc, str(key)))
        return result

    def scalar(self, node: Any, loc: Loc) -> Any:
        if node is None or isinstance(node, bool):
            return node
        if isinstance(node, int):
            return int(node) if abs(node) < LARGEST else self.refuse(loc, "is too large a number")
        if isinstance(node, float):
            number = float(node)
            if not math.isfinite(number):
                return self.refuse(loc, f"should be a finite number, not {number}")
            # 1e6 is a float in YAML and a count to people.
            return int(number) if number.is_integer() and abs(number) < 2**53 else number
        if isinstance(node, str):
            return str(node) if _whole(node) else self.refuse(loc, "holds an unpaired surrogate escape")
        hint = "put it in quotes" if isinstance(node, datetime.date) else "specs hold plain numbers, words, lists and mappings"
        return self.refuse(loc, f"{kind_of(node)} is no value of a spec", hint)

    def refuse(self, loc: Loc, message: str, hint: str | None = None) -> None:
        self.problems.append(self.source.problem(loc, message, hint))


def _no_key(key: Any) -> str | None:
    """Why something is no key of a spec."""
    if isinstance(key, bool) or not isinstance(key, str | int | float):
        shown = repr(key) if key is None or isinstance(key, bool) else kind_of(key)
        return f"a key should be a plain word, not {shown}"
    if isinstance(key, str):
        return None if _whole(key) else "a key should be a plain word, not an unpaired surrogate escape"
    return None if abs(key) < LARGEST else "a key should be a plain word, not so large a number"  # nan is too


def _whole(text: str) -> bool:
    """Whether a text can be written anywhere: a lone surrogate, which an escape can name, is no character."""
    return not any("\ud800" <= character <= "\udfff" for character in text)
