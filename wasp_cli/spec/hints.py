"""The settings of a spec by their dotted names, and the wording of mistakes: messages and hints."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from wasp_cli.errors import did_you_mean
from wasp_cli.spec.model import method_sections, spec_type, validate
from wasp_cli.spec.names import EXTENDS, TOP
from wasp_cli.spec.proposals import Proposal, proposals
from wasp_cli.spec.read import KEY, Loc
from wasp_cli.tasks.declared import Declaration


def model_at(loc: Loc) -> type[BaseModel] | None:
    """Return the model of the section at a place, also of an entry in `tasks`; the model of the
    whole spec for an empty place. None if there is no section.
    """
    model: type[BaseModel] = spec_type()
    if loc[:1] == ("tasks",) and len(loc) == 2:
        return Declaration
    if loc[:1] == ("by_task",) and len(loc) > 2:
        loc = loc[2:]
    for part in loc:
        below = _section(model.model_fields.get(str(part)))
        if below is None:
            return None
        model = below
    return model


def description(loc: Loc) -> str | None:
    """Return the description of a setting; None if there is no setting at this place."""
    model = model_at(loc[:-1])
    if model is None or not loc:
        return None
    field = model.model_fields.get(str(loc[-1]))
    if field is None:
        return None
    return field.description


@cache
def settings() -> tuple[str, ...]:
    """Return the dotted names of all settings of a spec, such as `wasp.horizon`."""
    return tuple(_below(spec_type(), ""))


def _below(model: type[BaseModel], prefix: str) -> Iterator[str]:
    for name, field in model.model_fields.items():
        yield prefix + name
        section = _section(field)
        if section is not None:
            yield from _below(section, f"{prefix}{name}.")


def _section(field: FieldInfo | None) -> type[BaseModel] | None:
    """The model of a field that is a section; None for any other field."""
    if field is None:
        return None
    members = get_args(field.annotation) or (field.annotation,)
    for member in members:
        if isinstance(member, type) and issubclass(member, BaseModel):
            return member
    return None


CLOSE = "did you mean"


def key_hint(loc: Loc) -> str:
    """Return a hint for an unknown key: similar keys of the same section, else the section that has
    the key or a similar one.
    """
    if loc == (EXTENDS,):  # in a file it is taken out before
        return "'extends' works only inside a file"
    name = str(loc[-1])
    section = ".".join(map(str, loc[:-1]))
    if section and name in (*spec_type().model_fields, *TOP):
        return f"'{name}' belongs at the top level, outside every section"
    model = model_at(loc[:-1])
    known: list[str] = []
    if model is not None:
        known += model.model_fields
    if not section:
        known += TOP
    hint = did_you_mean(name, known)
    if hint.startswith(CLOSE):
        return hint
    return _elsewhere(name, section) or hint


def _elsewhere(name: str, section: str) -> str | None:
    """A hint with settings of other sections that have this name, or a similar one."""
    # Those within the section come first.
    near = sorted(
        (path for path in settings() if "." in path),
        key=lambda path: not path.startswith(f"{section}."),
    )
    paths = [f"'{path}'" for path in near if path.rpartition(".")[2] == name][:3]
    if len(paths) == 1:
        return f"{CLOSE} {paths[0]}?"
    if paths:
        return f"{CLOSE} {', '.join(paths[:-1])} or {paths[-1]}?"

    # A similar name, with the whole path in its place.
    leaves = {path.rpartition(".")[2]: path for path in reversed(near)}
    hint = did_you_mean(name, leaves)
    if not hint.startswith(CLOSE):
        return None
    return re.sub(r"'([^']*)'", lambda leaf: f"'{leaves[leaf[1]]}'", hint)


Accepts = Callable[[Loc, Any], bool]
"""Whether a document with this value at this place has no mistake there."""


def _anything(loc: Loc, value: Any) -> bool:
    return True


def accepts_in(document: Mapping[str, Any]) -> Accepts:
    """Return a function that tells whether a document, which should be a spec, would be right at a
    place with another value there.
    """

    def accepts(loc: Loc, value: Any) -> bool:
        changed = copy.deepcopy(dict(document))
        node: Any = changed
        for part in loc[:-1]:
            node = node[part if isinstance(node, list) else str(part)]
        node[loc[-1] if isinstance(node, list) else str(loc[-1])] = value
        try:
            validate(changed)
        except ValidationError as error:
            places = [_without_tags(entry["loc"], changed) for entry in error.errors()]
            return all(place[: len(loc)] != loc for place in places)
        return True

    return accepts


def proposal(
    loc: Loc, entries: list[dict[str, Any]], document: Mapping[str, Any], accepts: Accepts
) -> Proposal | None:
    """Return a value, written as YAML, that would be accepted in place of a wrong one; None if no
    guess is accepted.
    """
    for candidate in proposals(loc, entries[0]["input"], entries):
        if not candidate.instead:
            fits = accepts(loc, candidate.value)
        else:
            # Its values stand in the place of one item of a list.
            whole: Any = document
            for part in loc[:-1]:
                whole = whole[part]
            index = int(loc[-1])
            fits = accepts(loc[:-1], [*whole[:index], *candidate.value, *whole[index + 1 :]])
        if fits:
            return candidate
    return None


@dataclass(frozen=True)
class Finding:
    """A mistake in a document, at a place of it."""

    loc: Loc
    message: str
    hint: str | None = None
    at_key: bool = False  # the key is wrong (or its whole section), not its value
    written: str | None = None  # the value that the hint proposes, as YAML


def misplaced(document: Mapping[str, Any]) -> list[Finding]:
    """Return a finding for each field that a section sets although only the top of a spec may set
    it.
    """
    # The sections of the spec, and those that tasks have of their own.
    places: list[tuple[Loc, Mapping[str, Any]]] = [((), document)]
    by_task = document.get("by_task")
    if isinstance(by_task, Mapping):
        for task, sections in by_task.items():
            if isinstance(sections, Mapping):
                places.append((("by_task", task), sections))

    mistakes: list[Finding] = []
    for above, sections in places:
        for name, (field, example) in not_set_in_sections().items():
            section = sections.get(name)
            model = model_at((name,))
            if not isinstance(section, Mapping) or field not in section:
                continue
            if model is None or field not in model.model_fields:
                continue
            hint = f"write `{example}` at the top, outside every section"
            loc = (*above, name, field, KEY)
            mistakes.append(Finding(loc, f"'{field}' is not set here", hint))
    return mistakes


def not_set_in_sections() -> dict[str, tuple[str, str]]:
    """Return, by section, the field that only the top of a spec may set, and an example of how."""
    return {"evaluate": ("episodes", "episodes: 30")} | dict.fromkeys(
        method_sections(), ("variant", "variants: [full]")
    )


Hint = Callable[[Loc], str | None]


def findings(
    error: ValidationError,
    document: Mapping[str, Any],
    key_hint: Hint = key_hint,
    description: Hint = description,
    accepts: Accepts = _anything,
) -> list[Finding]:
    """Return one finding for each wrong place of a document; pydantic has one error for each member
    of a union.

    Args:
        error: of the validation.
        document: that was validated.
        key_hint: returns a hint for an unknown key.
        description: returns what a missing key means.
        accepts: tells whether a value would be accepted. Hints propose only such values.
    """
    by_place: dict[Loc, list[dict[str, Any]]] = {}
    for entry in error.errors(include_url=False):
        by_place.setdefault(_without_tags(entry["loc"], document), []).append(dict(entry))
    # pydantic also calls a list too short if all of its entries are wrong. Only the entries are
    # reported then.
    sections = {loc[:length] for loc in by_place for length in range(len(loc))}
    propose = partial(proposal, document=document, accepts=accepts)
    worded: list[Finding] = []
    for loc, entries in by_place.items():
        if entries[0]["type"] == "too_short" and loc in sections:
            continue
        worded.append(_worded(loc, entries, key_hint, description, propose))
    return worded


def _without_tags(loc: Loc, document: Mapping[str, Any]) -> Loc:
    """A place of pydantic without the tags of unions, which no document has."""
    node: Any = document
    for index, part in enumerate(loc):
        if isinstance(node, Mapping) and str(part) in node:
            node = node[str(part)]
        elif isinstance(node, list) and isinstance(part, int) and part < len(node):
            node = node[part]
        elif not isinstance(node, Mapping | list):
            return loc[:index]  # what follows a scalar can only be the tag of a union
        else:
            return loc
    return loc


_WORDS = {  # pydantic's words for kinds of values, and those for a YAML file
    "an object": "a mapping of keys to values",
    "a valid dictionary": "a mapping of keys to values",
    "a valid array": "a list",
    "a valid tuple": "a list",
    "a valid integer": "an integer",
    "a valid ": "a ",
}


def _worded(
    loc: Loc,
    entries: list[dict[str, Any]],
    key_hint: Hint,
    description: Hint,
    propose: Callable[[Loc, list[dict[str, Any]]], Proposal | None],
) -> Finding:
    """The errors of pydantic at one place, as one message with a hint."""
    first = entries[0]
    kind = first["type"]
    context = first.get("ctx") or {}
    shown = _shown(first["input"])

    # Keys that are unknown or missing.
    if kind == "extra_forbidden" and str(loc[-1]) in settings() and "." in str(loc[-1]):
        section, _, field = str(loc[-1]).rpartition(".")
        written = f"{field}: {first['input']}" if shown != "a mapping" else field
        hint = f"write `{written}` in the section '{section}'; names with dots are for --set"
        return Finding(loc, f"unknown key '{loc[-1]}'", hint, at_key=True)
    if kind == "extra_forbidden":
        return Finding(loc, f"unknown key '{loc[-1]}'", key_hint(loc), at_key=True)
    if kind == "missing":
        message = first["msg"]
        if loc[-1:] != (KEY,):
            message = f"missing key '{loc[-1]}'"
            if len(loc) > 1:
                message += f" in '{'.'.join(map(str, loc[:-1]))}'"
        return Finding(loc, message, description(loc))

    # Mistakes that our own validators have worded.
    if "hint" in context or kind in ("repeated", "no_operator", "severity_range"):
        message = first["msg"]
        if kind == "severity_range":
            message += f", not {shown}"
        return Finding(loc, message, context.get("hint"))
    if kind == "value_error":
        return Finding(loc, str(context["error"]), at_key=True)
    if kind in ("too_short", "string_too_short"):
        return Finding(loc, "should not be empty", description(loc))
    if any(entry["type"] == "string_pattern_mismatch" for entry in entries):
        hint = "letters, digits, dot, dash and underscore, beginning with a letter or a digit"
        return Finding(loc, f"{shown} is not a usable name", hint)

    # Values of a wrong kind: what is expected, in the words of a YAML file, and a proposal.
    expected = [re.sub(r"^Input should ", "", entry["msg"]) for entry in entries]
    message = " or ".join(dict.fromkeys(expected)).replace(" or be ", " or ")
    message = re.sub(r" or instance of \w+", "", message)  # a file holds no objects of Python
    for theirs, ours in _WORDS.items():
        message = message.replace(theirs, ours)
    if message.startswith(("be ", "have ", "match ")):
        message = f"should {message}"
    if shown not in message:
        message = f"{message}, not {shown}"
    proposed = propose(loc, entries)
    if proposed is None:
        return Finding(loc, message)
    return Finding(loc, message, proposed.hint, written=proposed.written)


def _shown(value: Any) -> str:
    """A value as a message shows it, at most 40 characters."""
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, list | tuple):
        return "a list"
    if value is None:
        return "nothing (null)"
    if isinstance(value, float) and value.is_integer():
        value = int(value)  # as it is written
    text = repr(value)
    if isinstance(value, bool):
        text = str(value).lower()
    if len(text) <= 40:
        return text
    return text[:37] + "..."
