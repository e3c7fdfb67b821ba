"""Where ruamel's errors without a position come from: values that it cannot build (an impossible date) and merges into themselves."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode

from wasp_cli.spec.where import Position

_TAG = "tag:yaml.org,2002:"
_MERGE = f"{_TAG}merge"
_KINDS = {"int": "no integer", "float": "no number", "timestamp": "no date", "bool": "no boolean", "omap": "no ordered mapping"}
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
        if tag not in _KINDS:
            return None
        try:
            self.reader.constructor.construct_object(node)
        except Exception:  # whatever Python says of a text that is no number
            value = node.value if len(node.value) <= _LONGEST else node.value[: _LONGEST - 3] + "..."
            return _at(node), f"'{value}' is {_KINDS[tag]}"
        return None


def _at(node: Any) -> Position:
    return Position(node.start_mark.line + 1, node.start_mark.column + 1)
