"""Guesses at what a value of a wrong kind is meant to be, written as YAML. `hints` proposes the
first one that the spec accepts.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from wasp_cli.errors import did_you_mean
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.spec.read import Loc

LONGEST = 200  # characters of a text that guesses are made for
MOST = 100  # values of a range that are written out
SEVERITIES = ("mild", "moderate", "severe")  # names of severities in proposals
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_GROUPED = re.compile(r"\d{1,3}([,_' ]\d{3})+")
_RANGE = re.compile(r"(\d{1,10})\s*(?:-|–|\.\.+|to)\s*(\d{1,10})")
_PYTHONS_RANGE = re.compile(r"range\(\s*(?:(\d{1,10})\s*,\s*)?(\d{1,10})\s*\)")
_BOOLEANS = {
    "true": True,
    "yes": True,
    "on": True,
    "false": False,
    "no": False,
    "off": False,
}
_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")
_NO_WORDS = (*_BOOLEANS, "null", "y", "n")


@dataclass(frozen=True)
class Proposal:
    """A value that may be meant, and the hint that proposes it."""

    hint: str
    value: Any
    written: str | None = None  # the value as YAML, where the hint proposes no other one
    instead: bool = False  # whether the value's items stand in the place of one item of a list


def _one(words: str, value: Any) -> Proposal:
    text = flow(value)
    return Proposal(f"{words} {text}", value, text)


def proposals(loc: Loc, value: Any, entries: list[dict[str, Any]]) -> Iterator[Proposal]:
    """Yield what a wrong value may be meant as, the likeliest first. `entries` are pydantic's
    errors.
    """
    if isinstance(value, str) and len(value) > LONGEST:
        return
    types = [entry["type"] for entry in entries]
    if "tuple_type" in types:
        yield from _lists(loc, value)
    if "dict_type" in types:
        yield from _mappings(loc, value)
    if "bool_type" in types and str(value).lower() in _BOOLEANS:
        yield _one("write", _BOOLEANS[str(value).lower()])
    if "string_type" in types and isinstance(value, int | float):
        text = json.dumps(flow(value))
        yield Proposal(f"in quotes: {text}", flow(value), text)
    if isinstance(value, str) and ("int_type" in types or "float_type" in types):
        yield from _numbers(value)
        if isinstance(loc[-1], int):
            for items in _ranges(value):
                yield Proposal(f"write {flow(items)[1:-1]} in its place", items, instead=True)
    for entry in entries:
        if entry["type"] == "literal_error" and isinstance(value, str):
            allowed = re.findall(r"'([^']*)'", entry["ctx"]["expected"])
            hint = did_you_mean(value, allowed)
            close = [name for name in allowed if f"'{name}'" in hint]
            written = flow(close[0]) if len(close) == 1 else None
            yield from (Proposal(hint, name, written) for name in close or allowed)


def _lists(loc: Loc, value: Any) -> Iterator[Proposal]:
    if loc == ("seeds",) and isinstance(value, int) and 1 < value <= MOST:
        count = list(range(value))
        yield Proposal(f"write [{value}] for this seed, {flow(count)} for so many", count)
    lists: list[list[Any]] = []
    if isinstance(value, str):
        words = re.split(r"[\s,;]+", value.strip(" ,;"))
        lists += [*_ranges(value), [_read(word) for word in words]]
    if isinstance(value, str | int | float):
        lists.append([value])
    for items in lists:
        yield _one("write", items)


def _ranges(text: str) -> Iterator[list[int]]:
    """The whole numbers of a range, as `0-4`, `0..4` or `range(5)` write it."""
    match = _RANGE.fullmatch(text.strip())
    pythons = _PYTHONS_RANGE.fullmatch(text.strip())
    if match is not None:
        first = int(match[1])
        last = int(match[2])
    elif pythons is not None:
        first = int(pythons[1] or 0)
        last = int(pythons[2]) - 1
    else:
        return
    if 0 <= last - first < MOST:
        yield list(range(first, last + 1))


def _numbers(text: str) -> Iterator[Proposal]:
    """The number that a text may mean: in quotes, with separators, or with k or M."""
    number = _read(text.strip())
    with_unit = re.fullmatch(r"(\d{1,6})\s*([kM])", text)
    if not isinstance(number, str):
        yield Proposal(f"without quotes: {text.strip()}", number, text.strip())
    elif _GROUPED.fullmatch(text):
        yield _one("write", int(re.sub(r"\D", "", text)))
    elif with_unit is not None:
        yield _one("write", int(with_unit[1]) * {"k": 1000, "M": 1_000_000}[with_unit[2]])


def _read(word: str) -> Any:
    if not _NUMBER.fullmatch(word):
        return word
    number = float(word)
    return int(number) if number.is_integer() and abs(number) < 2**53 else number


def _mappings(loc: Loc, value: Any) -> Iterator[Proposal]:
    if len(loc) == 2 and loc[0] == "operators":
        values = value if isinstance(value, list) else [value]
        values = [_read(each) if isinstance(each, str) else each for each in values]
        names = SEVERITIES if len(values) > 1 else SEVERITIES[1:2]
        named = dict(zip(names, values, strict=False))
        if len(named) == len(values):
            yield _one("with a name, for example", named)
        yield _one("with a name, for example", {SEVERITIES[1]: _middle(str(loc[1]))})
    if loc == ("operators",) and isinstance(value, str | list):
        words = re.split(r"[\s,;]+", value.strip()) if isinstance(value, str) else value
        known = [word for word in words if isinstance(word, str) and word in OPERATORS]
        severities = {name: {SEVERITIES[1]: _middle(name)} for name in known}
        if len(known) == len(words):
            yield _one("with severities, for example", severities)


def _middle(operator: str) -> float:
    info = OPERATORS[operator]
    return (info.low + info.high) / 2


def flow(value: Any) -> str:
    """Write a JSON value as YAML on one line."""
    if isinstance(value, list):
        return f"[{', '.join(map(flow, value))}]"
    if isinstance(value, dict):
        entries = [f"{flow(name)}: {flow(item)}" for name, item in value.items()]
        return f"{{{', '.join(entries)}}}"
    plain = isinstance(value, str) and _PLAIN.fullmatch(value) and value.lower() not in _NO_WORDS
    return str(value) if plain else json.dumps(value)
