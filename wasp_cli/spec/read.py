"""From the text of a spec file to plain values, where each of them stands, and problems with their
places.

What YAML knows beyond JSON (dates, anchors, merges, tags) is a problem with a place: `extends` is
the one way to share sections.
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
    line: int
    column: int


START = Position(1, 1)


WIDEST = 160  # characters of a line that are shown
LONGEST = 1500  # characters of a message and of a hint


def shortened(text: str) -> str:
    """Return a text without its middle where it is too long to be read: a whole file may stand in
    one line, or in one name.
    """
    if len(text) <= LONGEST:
        return text
    return f"{text[: LONGEST // 2]} ... {text[-LONGEST // 4 :]}"


@dataclass(frozen=True)
class Problem:
    source: str  # the file as the user named it, or the option that brought the value
    position: Position | None
    message: str
    hint: str | None = None
    line: str | None = None  # text of the line at `position`

    @property
    def place(self) -> str:
        """`file:line:column`, which editors turn into a link."""
        return (
            self.source
            if self.position is None
            else f"{self.source}:{self.position.line}:{self.position.column}"
        )

    def __str__(self) -> str:
        place = shortened(self.place)
        message = shortened(printable(self.message))
        parts = [f"{place}: {message}", *self._excerpt()]
        if self.hint:
            parts.append(f"    {shortened(printable(self.hint))}")
        return "\n".join(parts)

    def as_json(self) -> dict[str, Any]:
        line, column = (
            (None, None) if self.position is None else (self.position.line, self.position.column)
        )
        return {
            "file": self.source,
            "line": line,
            "column": column,
            "message": shortened(self.message),
            "hint": None if self.hint is None else shortened(self.hint),
            "excerpt": None if self.line is None else self._window()[0],
        }

    def _window(self) -> tuple[str, int]:
        """What is shown of the line, and the column in it."""
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
    def __init__(self, problems: Sequence[Problem]) -> None:
        files = list(
            dict.fromkeys(problem.source for problem in problems if problem.position is not None)
        )

        def order(problem: Problem) -> tuple[int, int, int]:
            place = problem.position
            return (
                (len(files), 0, 0)
                if place is None
                else (files.index(problem.source), place.line, place.column)
            )

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
    name: str
    text: str
    # as JSON values; null where a value has no such form
    document: dict[str, Any] = field(default_factory=dict)
    places: dict[Loc, Place] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)  # what has no form as a JSON value

    def depth(self, loc: Loc) -> int:
        """Return how many parts of what pydantic calls a `loc` the document really has."""
        return self._known_part(loc)[1]

    def problem(
        self, loc: Loc, message: str, hint: str | None = None, *, at_key: bool = False
    ) -> Problem:
        return self.problem_at(self._position(loc, at_key), message, hint)

    def problem_at(self, position: Position, message: str, hint: str | None = None) -> Problem:
        lines = lines_of(self.text)
        line = lines[position.line - 1] if 0 < position.line <= len(lines) else None
        return Problem(self.name, position, message, hint, line or None)

    def _position(self, loc: Loc, at_key: bool) -> Position:
        known, depth, node = self._known_part(loc)
        if not known:
            return START
        whole = depth == len(loc) or loc[depth] == KEY
        # Of a section in which something is missing, the key says more than its first entry.
        lacking = depth < len(loc) and isinstance(node, dict | list)
        place = self.places[known]
        return place.key if lacking or (whole and (at_key or loc[-1] == KEY)) else place.value

    def _known_part(self, loc: Loc) -> tuple[Loc, int, Any]:
        """The part of a `loc` that the document has, how many parts of the `loc` that takes, and
        what stands there.

        pydantic's places also hold the tags of unions, which no file has, and fields that the file
        leaves out: a tag is skipped, and a missing field is reported at the mapping it is missing
        from.
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
    return parse(text_of(path), str(path))


def parse(text: str, name: str) -> Source:
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
        what = (
            "the file is empty"
            if values is None
            else f"a spec is a mapping of keys to values, not {kind_of(values)}"
        )
        raise InvalidSpec([source.problem_at(START, what, "specs/quickstart.yaml is an example")])
    source.document.update(values)
    return source


SHARING = {AnchorToken: "an anchor (&)", AliasToken: "an alias (*)", TagToken: "a tag (!)"}

_SHARED = re.compile("[&*!]|<<")


def _refuse_sharing(source: Source) -> None:
    """See that a text has no anchors, aliases, merges and tags: what is meant at one place
    should be read there.
    """
    if not _SHARED.search(source.text):  # reading the tokens takes as long as reading the text
        return
    for token in YAML(typ="safe", pure=True).scan(source.text):
        merge = isinstance(token, ScalarToken) and token.plain and token.value == "<<"
        if what := "a merge (<<)" if merge else SHARING.get(type(token)):
            hint = "write the value where it is used; whole sections are shared with `extends`"
            raise InvalidSpec([source.problem_at(_at(token), f"{what} is no part of a spec", hint)])


_TAG = "tag:yaml.org,2002:"
_NO_SCALAR = {
    "int": "not an integer",
    "float": "not a number",
    "timestamp": "not a valid date",
    "bool": "not a boolean",
}
"""By tag: what is said of a scalar that cannot be built."""


@dataclass(frozen=True)
class _Reader:
    """Makes JSON values of YAML nodes, and notes where they stand and what has no such form."""

    source: Source
    yaml: YAML

    def value(self, node: Any, loc: Loc) -> Any:
        if len(loc) > MAX_DEPTH:
            raise InvalidSpec([self.source.problem_at(_at(node), "nested too deeply")])
        if isinstance(node, MappingNode):
            return dict(self.entries(node, loc))
        if isinstance(node, SequenceNode):
            for index, item in enumerate(node.value):
                self.source.places[*loc, index] = Place(_at(item), _at(item))
            return [self.value(item, (*loc, index)) for index, item in enumerate(node.value)]
        scalar = self.scalar(node)
        if (reason := _no_value(scalar)) is None:
            # 1e6 is a float in YAML and a count to people.
            return (
                int(scalar)
                if isinstance(scalar, float) and scalar.is_integer() and abs(scalar) < 2**53
                else scalar
            )
        self.source.problems.append(self.source.problem_at(_at(node), reason))
        return None

    def entries(self, node: MappingNode, loc: Loc) -> Iterator[tuple[str, Any]]:
        keys: set[str] = set()
        for key_node, value_node in node.value:
            key = self.scalar(key_node)
            if (reason := _no_key(key)) is not None:
                self.source.problems.append(
                    self.source.problem_at(
                        _at(key_node), f"a key should be a plain word, not {reason}"
                    )
                )
                continue
            name = str(key)
            if name in keys:
                hint = "each key may stand once; which of the values is meant?"
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
        """The value of a scalar; of another node an empty one of its kind."""
        if not isinstance(node, ScalarNode):
            return {} if isinstance(node, MappingNode) else []
        tag = str(node.tag).removeprefix(_TAG)
        if tag not in (*_NO_SCALAR, "null"):
            return node.value
        try:
            return self.yaml.constructor.construct_object(node)
        except Exception as error:  # whatever Python says of a text that is no number
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
    return (
        "a date is no value of a spec; put it in quotes"
        if isinstance(scalar, datetime.date)
        else None
    )


def _no_key(key: Any) -> str | None:
    if isinstance(key, str):
        return None if _whole(key) else "an unpaired surrogate escape"
    if key is None or isinstance(key, bool):
        return repr(key)
    if isinstance(key, int | float):
        return None if abs(key) < LARGEST else "so large a number"  # nan is too
    return kind_of(key)


def _whole(text: str) -> bool:
    """Whether a text can be written anywhere: a lone surrogate, which an escape can name, is no
    character.
    """
    return not any("\ud800" <= character <= "\udfff" for character in text)


def _at(node: Any) -> Position:
    return Position(node.start_mark.line + 1, node.start_mark.column + 1)


def text_of(path: Path) -> str:
    """Return the text of a spec file. Raises InvalidSpec where it cannot be read, or is none."""
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
    """Return a hint for those who look for a spec that is not there: what is nearly called so,
    or what there is.
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
    """Return the lines of a text as YAML 1.2 and editors count them; Python's `splitlines` also
    ends them at rarer characters.
    """
    return re.split(r"\r\n|\r|\n", text)


def _yaml_problem(source: Source, error: MarkedYAMLError) -> Problem:
    mark = error.problem_mark or error.context_mark
    position = Position(mark.line + 1, mark.column + 1) if mark is not None else START
    what = (error.problem or error.context or "not valid YAML").strip()
    hint = "indent with spaces; a tab is not allowed there" if "\\t" in what else None
    return source.problem_at(position, f"not valid YAML: {what}", hint)


def kind_of(value: Any) -> str:
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
    return ".".join(str(part) for part in loc if part != KEY)
