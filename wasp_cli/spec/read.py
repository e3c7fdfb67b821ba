"""From the text of a spec file to its sections: reading, and values that stand at a wrong place."""

from __future__ import annotations

import datetime
import re
import warnings
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import MarkedYAMLError, ReusedAnchorWarning, YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

from wasp_cli.errors import did_you_mean
from wasp_cli.spec.places import KEY, START, InvalidSpec, Loc, Position, Problem, locate

MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class Source:
    """The text of a spec and its document."""

    name: str
    text: str
    document: Any

    def problem(self, loc: Loc, message: str, hint: str | None = None, *, at_key: bool = False) -> Problem:
        """A problem at a place of the document; where another section has it, through a merge or an alias, the message says who uses it."""
        place = locate(self.document, loc, at_key=at_key)
        return self.problem_at(place.position, f"{dotted(loc)}: {message}" if place.borrowed else message, hint)

    def problem_at(self, position: Position, message: str, hint: str | None = None) -> Problem:
        """A problem at a position of the text."""
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ReusedAnchorWarning)  # YAML allows it: an alias means the last one above it
        document = _document(source)
    if not isinstance(document, CommentedMap):
        what = "the file is empty" if document is None else f"a spec is a mapping of keys to values, not {kind_of(document)}"
        raise InvalidSpec([source.problem_at(START, what, "specs/quickstart.yaml is an example")])
    return Source(name, text, document)


def _document(source: Source) -> Any:
    text = source.text
    try:
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


def _text(path: Path) -> str:
    def refuse(message: str, hint: str | None = None) -> InvalidSpec:
        return InvalidSpec([Problem(str(path), START, message, hint)])

    try:
        if path.is_dir():
            raise refuse("is a folder, not a spec file", beside(path))
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise refuse("no such file", beside(path.parent, path.name)) from error
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


def beside(folder: Path, name: str = "") -> str | None:
    """A hint for those who look for a spec that is not there: what is nearly called so in the folder, or what there is."""
    try:
        found = sorted(folder.glob("*.yaml"))
    except OSError:
        return None
    # Without the ending, which makes all of them alike.
    hint = did_you_mean(Path(name).stem, [path.stem for path in found], otherwise="here are: " + ", ".join(map(str, found[:8])))
    return re.sub(r"'([^']*)'", r"'\1.yaml'", hint) if hint.startswith("did you mean") else hint if found else None


def _position_of(text: str, index: int) -> Position:
    lines = lines_of(text[:index])
    return Position(len(lines), len(lines[-1]) + 1)


def lines_of(text: str) -> list[str]:
    """The lines of a text as YAML 1.2 and editors count them; Python's `splitlines` also ends them at rarer characters."""
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
    "CommentedSet": "a set",
    "CommentedOrderedMap": "an ordered mapping",
    "TaggedScalar": "a value with a tag",
    "bytes": "binary data",
}


def kind_of(node: Any) -> str:
    """What people call a value of a YAML document."""
    if isinstance(node, str):
        return "a single word" if " " not in node and "\n" not in node else "plain text"
    if isinstance(node, datetime.date):  # ruamel's timestamps too
        return "a date"
    name = type(node).__name__
    return _KINDS.get(name, f"a {name}")


def dotted(loc: Loc) -> str:
    """A place as `--set` names it."""
    return ".".join(str(part) for part in loc if part != KEY)


_TAG = "tag:yaml.org,2002:"
_MERGE = f"{_TAG}merge"
_NO_SCALAR = {"int": "no integer", "float": "no number", "timestamp": "no date", "bool": "no boolean", "omap": "no ordered mapping"}
"""By tag: what is said of a scalar that cannot be built. Those of other tags always can, or have an error with a position."""
_LONGEST = 40
Fault = tuple[Position, str]


def unplaced(text: str) -> Fault | None:
    """The place and the reason of the first value in a text that cannot be built, or None when every one can."""
    reader = YAML(typ="rt")
    with suppress(RecursionError):
        return _Search(reader).within(reader.compose(text), ())
    return None


@dataclass
class _Search:
    reader: YAML
    seen: set[int] = field(default_factory=set)
    """Aliases lead to a node many times."""

    def within(self, node: Any, above: tuple[int, ...]) -> Fault | None:
        if id(node) in self.seen:
            return None
        self.seen.add(id(node))
        above = (*above, id(node))
        below: list[Any] = []
        if isinstance(node, ScalarNode):
            return self.built(node, str(node.tag).removeprefix(_TAG))
        if isinstance(node, SequenceNode):
            below = node.value
        elif isinstance(node, MappingNode):
            for key, value in node.value:
                merged = value.value if isinstance(value, SequenceNode) else [value]
                if key.tag == _MERGE and any(id(each) in above for each in merged):
                    return _at(key), "a merge (<<) brings a mapping into itself"
                below += [key, value]
        return next((fault for each in below if (fault := self.within(each, above)) is not None), None)

    def built(self, node: ScalarNode, tag: str) -> Fault | None:
        if tag not in _NO_SCALAR:
            return None
        try:
            self.reader.constructor.construct_object(node)
        except Exception:  # whatever Python says of a text that is no number
            value = node.value if len(node.value) <= _LONGEST else node.value[: _LONGEST - 3] + "..."
            return _at(node), f"'{value}' is {_NO_SCALAR[tag]}"
        return None


def _at(node: Any) -> Position:
    return Position(node.start_mark.line + 1, node.start_mark.column + 1)
