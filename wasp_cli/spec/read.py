"""From the text of a spec file to JSON values, the place of each, and problems with their places.

What YAML has beyond JSON (dates, anchors, merges, tags) is a problem: sections are shared only by
`extends`.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.tokens import AliasToken, AnchorToken, ScalarToken, TagToken

from wasp_cli.errors import SpecError, did_you_mean
from wasp_cli.spec.shipped import shipped_names
from wasp_cli.store.plain import printable

Loc = tuple[str | int, ...]
KEY = "[key]"  # how pydantic ends the place of a key (not of its value)


@dataclass(frozen=True)
class Position:
    """A place in a file; line and column count from 1."""

    line: int
    column: int


START = Position(1, 1)


WIDEST = 160  # characters of a line that are shown
LONGEST = 1500  # characters of a message and of a hint


def shortened(text: str) -> str:
    """Return a text without its middle if it is longer than LONGEST; a file may hold megabytes in
    one line.
    """
    if len(text) <= LONGEST:
        return text
    return f"{text[: LONGEST // 2]} ... {text[-LONGEST // 4 :]}"


@dataclass(frozen=True)
class Problem:
    """A mistake with its place, as `str` prints it: place and message, the line with a caret, and a
    hint.
    """

    source: str  # the file as the user named it, or the option that brought the value
    position: Position | None
    message: str
    hint: str | None = None
    line: str | None = None  # text of the line at `position`

    @property
    def place(self) -> str:
        """`file:line:column`, which editors turn into a link."""
        if self.position is None:
            return self.source
        return f"{self.source}:{self.position.line}:{self.position.column}"

    def __str__(self) -> str:
        place = shortened(self.place)
        message = shortened(printable(self.message))
        parts = [f"{place}: {message}", *self._excerpt()]
        if self.hint:
            parts.append(f"    {shortened(printable(self.hint))}")
        return "\n".join(parts)

    def as_json(self) -> dict[str, Any]:
        """Return the problem as JSON values, for editors and programs."""
        return {
            "file": self.source,
            "line": None if self.position is None else self.position.line,
            "column": None if self.position is None else self.position.column,
            "message": shortened(self.message),
            "hint": None if self.hint is None else shortened(self.hint),
            "excerpt": None if self.line is None else self._window()[0],
        }

    def _window(self) -> tuple[str, int]:
        """The part of the line that is shown, and the column in it."""
        line = self.line or ""
        column = self.position.column if self.position is not None else 1
        if len(line) <= WIDEST:
            return line, column
        first = max(min(column - 1 - WIDEST // 2, len(line) - WIDEST), 0)
        before = "... " if first else ""
        after = " ..." if first + WIDEST < len(line) else ""
        shown = line[first : first + WIDEST]
        return f"{before}{shown}{after}", len(before) + column - first

    def _excerpt(self) -> list[str]:
        if self.position is None or self.line is None:
            return []
        line, column = self._window()
        # Tabs stay tabs, so that the caret stands under its character at any tab width.
        before = "".join("\t" if character == "\t" else " " for character in line[: column - 1])
        return [f"{self.position.line:>5} | {printable(line)}", f"      | {before}^"]


class InvalidSpec(SpecError):
    """A spec with mistakes. `problems` has all of them, ordered by file, line and column; those of
    options come last.
    """

    def __init__(self, problems: Sequence[Problem]) -> None:
        files = list(
            dict.fromkeys(problem.source for problem in problems if problem.position is not None)
        )

        def order(problem: Problem) -> tuple[int, int, int]:
            position = problem.position
            if position is None:
                return len(files), 0, 0
            return files.index(problem.source), position.line, position.column

        self.problems = tuple(sorted(problems, key=order))
        super().__init__("\n".join(map(str, self.problems)))

    def __reduce__(self) -> tuple[type[InvalidSpec], tuple[tuple[Problem, ...]]]:  # type: ignore[override]
        return type(self), (self.problems,)


MAX_BYTES = 1_000_000
# of lists and mappings in each other; JSON readers give up at some depth without a place
MAX_DEPTH = 32
LARGEST = 2**63  # numbers of a spec lie below it


@dataclass(frozen=True)
class Place:
    """Where an entry of a document is written."""

    key: Position  # the value's position for an entry of a list, which has no key
    value: Position  # the key's position for an empty value


@dataclass(frozen=True)
class Source:
    """A parsed file: its values, and where each of them is written."""

    name: str
    text: str
    # as JSON values; null where a value has no such form
    document: dict[str, Any] = field(default_factory=dict)
    places: dict[Loc, Place] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)  # what has no form as a JSON value

    def depth(self, loc: Loc) -> int:
        """Return how many parts of a place that pydantic names exist in the document."""
        return self._known_part(loc)[1]

    def problem(
        self, loc: Loc, message: str, hint: str | None = None, *, at_key: bool = False
    ) -> Problem:
        """Return a problem at a place of the document.

        Args:
            loc: the place, as pydantic names it.
            message: what is wrong.
            hint: what to do.
            at_key: whether the key is wrong (or the whole section) rather than the value.
        """
        return self.problem_at(self._position(loc, at_key), message, hint)

    def problem_at(self, position: Position, message: str, hint: str | None = None) -> Problem:
        """Return a problem at a position of the text, with the text of its line."""
        lines = lines_of(self.text)
        line = lines[position.line - 1] if 0 < position.line <= len(lines) else None
        return Problem(self.name, position, message, hint, line or None)

    def _position(self, loc: Loc, at_key: bool) -> Position:
        known, depth, node = self._known_part(loc)
        if not known:
            return START
        place = self.places[known]
        # For a section in which something is missing, its key is clearer than its first entry.
        is_missing = depth < len(loc) and isinstance(node, dict | list)
        is_whole = depth == len(loc) or loc[depth] == KEY
        if is_missing or (is_whole and (at_key or loc[-1] == KEY)):
            return place.key
        return place.value

    def _known_part(self, loc: Loc) -> tuple[Loc, int, Any]:
        """The part of a `loc` that the document has, how many parts of the `loc` that takes, and
        the value there.

        pydantic's places also have the tags of unions and fields that the file leaves out. A tag is
        skipped, and a missing field is reported at the mapping that lacks it.
        """
        known: Loc = ()
        depth = 0
        node = self.document
        for index, part in enumerate(loc):
            if _has(node, part):
                key = str(part) if isinstance(node, dict) else part
                known = (*known, key)
                depth = index + 1
                node = node[key]
            elif not depth or index + 1 >= len(loc) or not _has(node, loc[index + 1]):
                break
        return known, depth, node


def _has(node: Any, part: str | int) -> bool:
    if isinstance(node, dict):
        return str(part) in node
    return isinstance(node, list) and isinstance(part, int) and 0 <= part < len(node)


def read(path: Path) -> Source:
    """Read and parse a file. Raises InvalidSpec as `text_of` and `parse` do."""
    return parse(text_of(path), str(path))


def parse(text: str, name: str) -> Source:
    """Parse a text into JSON values with their places. Values that JSON does not have become null,
    with a problem in `Source.problems`.

    Args:
        name: of the file, for messages.

    Raises:
        InvalidSpec: it is not YAML, not a mapping, or has duplicate keys, anchors, aliases or tags.
    """
    source = Source(name, text)
    try:
        _refuse_sharing(source)
        reader = YAML(typ="safe", pure=True)
        root = reader.compose(text)
        values = _Reader(source, reader).value(root, ()) if root is not None else None
    except MarkedYAMLError as error:
        raise InvalidSpec([_yaml_problem(source, error)]) from error
    except ReaderError as error:
        position = _position_of(text, error.position or 0)
        raise InvalidSpec(
            [source.problem_at(position, f"not a text file: {error.reason}")]
        ) from error
    except RecursionError as error:
        raise InvalidSpec([source.problem_at(START, "nested too deeply")]) from error
    except (
        YAMLError,
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        IndexError,
        AssertionError,
        NotImplementedError,
    ) as error:
        # ruamel lets errors of Python through, without a position.
        raise InvalidSpec([source.problem_at(START, f"not valid YAML: {error}")]) from error
    if not isinstance(values, dict):
        what = "the file is empty"
        if values is not None:
            what = f"a spec is a mapping of keys to values, not {kind_of(values)}"
        raise InvalidSpec([source.problem_at(START, what, "specs/quickstart.yaml is an example")])
    source.document.update(values)
    return source


SHARING = {AnchorToken: "an anchor (&)", AliasToken: "an alias (*)", TagToken: "a tag (!)"}

_SHARED = re.compile("[&*!]|<<")


def _refuse_sharing(source: Source) -> None:
    """Raise InvalidSpec if a text has anchors, aliases, merges or tags: every value is to be read
    where it counts.
    """
    if not _SHARED.search(source.text):  # scanning for tokens takes as long as parsing
        return
    for token in YAML(typ="safe", pure=True).scan(source.text):
        what = SHARING.get(type(token))
        if isinstance(token, ScalarToken) and token.plain and token.value == "<<":
            what = "a merge (<<)"
        if what is not None:
            hint = "write the value where it is used; whole sections are shared with `extends`"
            message = f"{what} is not allowed in a spec"
            raise InvalidSpec([source.problem_at(_at(token), message, hint)])


_TAG = "tag:yaml.org,2002:"
_NO_SCALAR = {
    "int": "not an integer",
    "float": "not a number",
    "timestamp": "not a valid date",
    "bool": "not a boolean",
}
"""By tag: what is wrong with a scalar that cannot be built."""


@dataclass(frozen=True)
class _Reader:
    """Turns YAML nodes into JSON values, and notes their places and what JSON does not have."""

    source: Source
    yaml: YAML

    def value(self, node: Any, loc: Loc) -> Any:
        """The value of a node at a place; None with a problem if JSON has no such value."""
        if len(loc) > MAX_DEPTH:
            raise InvalidSpec([self.source.problem_at(_at(node), "nested too deeply")])
        if isinstance(node, MappingNode):
            return dict(self.entries(node, loc))
        if isinstance(node, SequenceNode):
            for index, item in enumerate(node.value):
                self.source.places[*loc, index] = Place(_at(item), _at(item))
            return [self.value(item, (*loc, index)) for index, item in enumerate(node.value)]
        scalar = self.scalar(node)
        reason = _no_value(scalar)
        if reason is not None:
            self.source.problems.append(self.source.problem_at(_at(node), reason))
            return None
        # 1e6 is a float in YAML, but people write it for a count.
        if isinstance(scalar, float) and scalar.is_integer() and abs(scalar) < 2**53:
            return int(scalar)
        return scalar

    def entries(self, node: MappingNode, loc: Loc) -> Iterator[tuple[str, Any]]:
        """Yield the entries of a mapping. Raises InvalidSpec for a key that is there twice."""
        keys: set[str] = set()
        for key_node, value_node in node.value:
            key = self.scalar(key_node)
            reason = _no_key(key)
            if reason is not None:
                message = f"a key should be a plain word, not {reason}"
                self.source.problems.append(self.source.problem_at(_at(key_node), message))
                continue
            name = str(key)
            if name in keys:
                hint = "write each key once"
                raise InvalidSpec(
                    [self.source.problem_at(_at(key_node), f"found duplicate key '{name}'", hint)]
                )
            keys.add(name)
            empty = value_node.tag == f"{_TAG}null"
            self.source.places[*loc, name] = Place(
                _at(key_node), _at(key_node if empty else value_node)
            )
            yield name, self.value(value_node, (*loc, name))

    def scalar(self, node: Any) -> Any:
        """The value of a scalar; for another node an empty mapping or list."""
        if not isinstance(node, ScalarNode):
            return {} if isinstance(node, MappingNode) else []
        tag = str(node.tag).removeprefix(_TAG)
        if tag not in (*_NO_SCALAR, "null"):
            return node.value
        try:
            return self.yaml.constructor.construct_object(node)
        except Exception as error:  # whatever Python raises for such a text
            value = node.value if len(node.value) <= 40 else node.value[:37] + "..."
            message = f"not valid YAML: '{value}' is {_NO_SCALAR.get(tag, 'no value')}"
            raise InvalidSpec([self.source.problem_at(_at(node), message)]) from error


def _no_value(scalar: Any) -> str | None:
    if isinstance(scalar, int) and abs(scalar) >= LARGEST:
        return "is too large a number"
    if isinstance(scalar, float) and not math.isfinite(scalar):
        return f"should be a finite number, not {scalar}"
    if isinstance(scalar, str) and not _whole(scalar):
        return "holds an unpaired surrogate escape"
    if isinstance(scalar, datetime.date):
        return "a date is not a value of a spec; put it in quotes"
    return None


def _no_key(key: Any) -> str | None:
    if isinstance(key, str):
        return None if _whole(key) else "an unpaired surrogate escape"
    if key is None or isinstance(key, bool):
        return repr(key)
    if isinstance(key, int | float):
        return None if abs(key) < LARGEST else "so large a number"  # nan is too
    return kind_of(key)


def _whole(text: str) -> bool:
    """Whether a text can be encoded: an escape can name a lone surrogate, which cannot."""
    return not any("\ud800" <= character <= "\udfff" for character in text)


def _at(node: Any) -> Position:
    return Position(node.start_mark.line + 1, node.start_mark.column + 1)


def text_of(path: Path) -> str:
    """Return the text of a spec file. Raises InvalidSpec if it cannot be read, is not UTF-8, or is
    larger than MAX_BYTES.
    """
    position = START
    hint = None
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) <= MAX_BYTES:
            return data.decode("utf-8-sig")
        message = f"is larger than {MAX_BYTES:,} bytes, too large for a spec"
    except IsADirectoryError:
        message = "is a folder, not a spec file"
        hint = meant(path / "*")
    except FileNotFoundError:
        message = "no such file"
        hint = meant(path)
    except UnicodeDecodeError as error:
        before = data[: error.start].decode("utf-8", errors="replace")
        position = _position_of(before, len(before))
        message = f"not a text file: byte 0x{data[error.start]:02x} is not UTF-8"
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        message = f"cannot be read: {getattr(error, 'strerror', None) or error}"
    raise InvalidSpec([Problem(str(path), position, message, hint)])


def meant(path: Path) -> str:
    """Return a hint for the name of a spec that is not there: similar names, or all that there
    are.
    """
    try:
        names = [file.stem for file in sorted(path.parent.glob("*.yaml"))]
    except OSError:
        names = []
    return did_you_mean(path.stem, dict.fromkeys([*names, *shipped_names()]))


def _position_of(text: str, index: int) -> Position:
    lines = lines_of(text[:index])
    return Position(len(lines), len(lines[-1]) + 1)


def lines_of(text: str) -> list[str]:
    """Return the lines of a text as YAML 1.2 and editors count them. Python's `splitlines` also
    splits at rarer characters.
    """
    return re.split(r"\r\n|\r|\n", text)


def _yaml_problem(source: Source, error: MarkedYAMLError) -> Problem:
    mark = error.problem_mark or error.context_mark
    position = Position(mark.line + 1, mark.column + 1) if mark is not None else START
    what = (error.problem or error.context or "not valid YAML").strip()
    hint = "indent with spaces; a tab is not allowed there" if "\\t" in what else None
    return source.problem_at(position, f"not valid YAML: {what}", hint)


def kind_of(value: Any) -> str:
    """Return what kind of value this is in the words of a YAML file, such as `a list`."""
    names = {
        str: "text",
        int: "a number",
        float: "a number",
        datetime.date: "a date",
        Mapping: "a mapping",
        list: "a list",
    }
    return next((name for kind, name in names.items() if isinstance(value, kind)), "nothing")


def dotted(loc: Loc) -> str:
    """Return a place as a dotted name, such as `wasp.horizon`."""
    return ".".join(str(part) for part in loc if part != KEY)
