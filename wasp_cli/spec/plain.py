"""The plain values of a document: what JSON can hold. Everything else that YAML knows (dates, tags, sets) is a problem with a place."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from ruamel.yaml.comments import CommentedMap, CommentedOrderedMap, CommentedSeq

from wasp_cli.spec.places import LARGEST, START, InvalidSpec, Loc, Problem, key_position
from wasp_cli.spec.read import Source, kind_of

MAX_VALUES = 100_000
"""Aliases of aliases can stand for more values than any memory holds."""
MAX_DEPTH = 32
"""Of lists and mappings in each other; JSON readers give up at some depth without a place."""


def plain(source: Source) -> tuple[dict[str, Any], list[Problem]]:
    """The document as JSON values, and what in it is none.

    Raises:
        InvalidSpec: it has too many values or levels for anything to be said of them.
    """
    reader = _Reader(source)
    values: dict[str, Any] = reader.value(source.document, (), ())
    return values, reader.problems


@dataclass
class _Reader:
    source: Source
    problems: list[Problem] = field(default_factory=list)
    budget: Iterator[int] = field(default_factory=lambda: iter(range(MAX_VALUES)))

    def value(self, node: Any, loc: Loc, above: tuple[int, ...]) -> Any:
        if next(self.budget, None) is None:
            raise InvalidSpec([self.source.problem_at(START, f"more than {MAX_VALUES:,} values; aliases of aliases?")])
        if id(node) in above:
            self.problems.append(self.source.problem(loc, "contains itself through an alias", at_key=True))
            return None
        if len(above) > MAX_DEPTH:
            raise InvalidSpec([self.source.problem(loc, "nested too deeply")])
        above = (*above, id(node))
        if isinstance(node, CommentedMap) and not isinstance(node, CommentedOrderedMap):
            return self.mapping(node, loc, above)
        if isinstance(node, CommentedSeq):
            return [self.value(value, (*loc, index), above) for index, value in enumerate(node)]
        return self.scalar(node, loc)

    def mapping(self, node: CommentedMap, loc: Loc, above: tuple[int, ...]) -> dict[str, Any]:
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
            result[str(key)] = self.value(value, (*loc, str(key)), above)
        return result

    def scalar(self, node: Any, loc: Loc) -> Any:
        if node is None or isinstance(node, bool):
            return node
        if type(node).__name__ == "ScalarBoolean":  # an anchored true is an int to ruamel
            return bool(node)
        if isinstance(node, int):
            return int(node) if abs(node) < LARGEST else self.refuse(loc, "is too large a number")
        if isinstance(node, float):
            number = float(node)
            if not math.isfinite(number):
                return self.refuse(loc, f"should be a finite number, not {number}")
            # 1e6 is a float in YAML and a count to people.
            return int(number) if number.is_integer() and abs(number) < 2**53 else number
        if isinstance(node, str):
            return str(node) if _whole(node) else self.refuse(loc, "holds half a character: an escape for a surrogate without the other")
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
        return None if _whole(key) else "a key should be a plain word, not half a character"
    return None if abs(key) < LARGEST else "a key should be a plain word, not so large a number"  # nan is too


def _whole(text: str) -> bool:
    """Whether a text can be written anywhere: a lone surrogate, which an escape can name, is no character."""
    return not any("\ud800" <= character <= "\udfff" for character in text)
