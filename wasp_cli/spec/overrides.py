"""`--set a.b=value`: one more line of the spec, from the command line."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from wasp_cli.errors import UsageError
from wasp_cli.spec.plain import plain
from wasp_cli.spec.problem import InvalidSpec
from wasp_cli.spec.read import parse


@dataclass(frozen=True)
class Override:
    """One option: where it puts which value."""

    text: str
    path: tuple[str, ...]
    value: Any
    option: str = "--set"
    """The option that brought it, for messages."""


def override(number: int, text: str) -> Override:
    """Read `a.b=value`; the value is YAML, so that lists, numbers and null keep their types.

    Raises:
        UsageError: the text has another form, or its value is not YAML.
    """
    place = f"--set #{number}"
    key, equals, value = text.partition("=")
    path = path_of(key)
    if not equals or not all(path):
        example = "for example --set wasp.candidates=64 or --set 'seeds=[0, 1]'"
        raise UsageError(f"{place}: '{text}' is not of the form key=value", example)
    found = value_of(value, text, place)
    if path == ("task",):  # the short form, as in a file
        return Override(text, ("tasks",), found if isinstance(found, list) else [found])
    return Override(text, path, found)


def path_of(key: str) -> tuple[str, ...]:
    """`a.b` as the names on the way to a value; one of them is empty where the key is none."""
    return tuple(part.strip() for part in key.split("."))


def value_of(value: str, text: str, place: str) -> Any:
    """The value that a text on the command line stands for.

    Args:
        value: YAML.
        text: what to quote in a message.
        place: which option it came from.

    Raises:
        UsageError: it is not YAML, or no value of a spec.
    """
    try:
        document, problems = plain(parse(f"value: {value.strip()}", text))
    except InvalidSpec as error:
        raise UsageError(f"{place}: the value of '{text}' is not YAML: {error.problems[0].message}") from error
    if problems or set(document) != {"value"}:
        reason = problems[0].message if problems else "more than one value"
        raise UsageError(f"{place}: '{text}': {reason}")
    return document["value"]


def apply(document: dict[str, Any], overrides: Sequence[Override]) -> dict[str, Any]:
    """The document with the options in it, later ones over earlier ones."""
    result = copy.deepcopy(document)
    for option in overrides:
        node = result
        for part in option.path[:-1]:
            below = node.get(part)
            node[part] = below = below if isinstance(below, dict) else {}
            node = below
        node[option.path[-1]] = option.value
    return result
