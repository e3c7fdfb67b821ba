"""The settings of a spec by their dotted names, and what is said where a file has another one:
wordings and suggestions.
"""

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
    """Return the model of a section, a task's own included; that of the whole spec for an empty
    place.
    """
    model: type[BaseModel] = spec_type()
    if loc[:1] == ("tasks",) and len(loc) == 2:
        return Declaration
    loc = loc[2:] if loc[:1] == ("by_task",) and len(loc) > 2 else loc
    for part in loc:
        below = _section(model.model_fields.get(str(part)))
        if below is None:
            return None
        model = below
    return model


def description(loc: Loc) -> str | None:
    model = model_at(loc[:-1])
    field = model.model_fields.get(str(loc[-1])) if model is not None and loc else None
    return field.description if field is not None else None


@cache
def settings() -> tuple[str, ...]:
    return tuple(_below(spec_type(), ""))


def _below(model: type[BaseModel], prefix: str) -> Iterator[str]:
    for name, field in model.model_fields.items():
        yield prefix + name
        if (section := _section(field)) is not None:
            yield from _below(section, f"{prefix}{name}.")


def _section(field: FieldInfo | None) -> type[BaseModel] | None:
    members = () if field is None else get_args(field.annotation) or (field.annotation,)
    models = [
        member for member in members if isinstance(member, type) and issubclass(member, BaseModel)
    ]
    return models[0] if models else None


CLOSE = "did you mean"


def key_hint(loc: Loc) -> str:
    """Close keys of the same section, or the section that has the key, or one that has a close
    key.
    """
    if loc == (EXTENDS,):  # in a file it is taken out before
        return "'extends' works only inside a file"
    name = str(loc[-1])
    section = ".".join(map(str, loc[:-1]))
    if section and name in (*spec_type().model_fields, *TOP):
        return f"'{name}' belongs at the top level, outside every section"
    model = model_at(loc[:-1])
    known = [*(model.model_fields if model is not None else ()), *(TOP if not section else ())]
    hint = did_you_mean(name, known)
    return hint if hint.startswith(CLOSE) else _elsewhere(name, section) or hint


def _elsewhere(name: str, section: str) -> str | None:
    """Settings of other sections with this name, or nearly: first those within the section."""
    near = sorted(
        (path for path in settings() if "." in path),
        key=lambda path: not path.startswith(f"{section}."),
    )
    paths = [f"'{path}'" for path in near if path.rpartition(".")[2] == name][:3]
    if paths:
        return f"{CLOSE} " + " or ".join(filter(None, (", ".join(paths[:-1]), paths[-1]))) + "?"
    leaves = {path.rpartition(".")[2]: path for path in reversed(near)}
    hint = did_you_mean(name, leaves)
    return (
        re.sub(r"'([^']*)'", lambda leaf: f"'{leaves[leaf[1]]}'", hint)
        if hint.startswith(CLOSE)
        else None
    )


Accepts = Callable[[Loc, Any], bool]
"""Whether a document with a value at a place has nothing wrong there."""


def _anything(loc: Loc, value: Any) -> bool:
    return True


def accepts_in(document: Mapping[str, Any]) -> Accepts:
    """Return what tries values in a document that is to be a spec."""

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
    """Return how a value is written that is accepted in the place of this one, or the closest
    allowed word; None where one cannot tell.
    """
    for meant in proposals(loc, entries[0]["input"], entries):
        if not meant.instead:
            fits = accepts(loc, meant.value)
        else:
            whole: Any = document
            for part in loc[:-1]:
                whole = whole[part]
            index = int(loc[-1])
            fits = accepts(loc[:-1], [*whole[:index], *meant.value, *whole[index + 1 :]])
        if fits:
            return meant
    return None


@dataclass(frozen=True)
class Finding:
    loc: Loc
    message: str
    hint: str | None = None
    at_key: bool = False  # the key is wrong (or its whole section), not its value
    written: str | None = None  # the value that the hint proposes, as YAML


def misplaced(document: Mapping[str, Any]) -> list[Finding]:
    mistakes: list[Finding] = []
    by_task = document.get("by_task")
    tasks = by_task.items() if isinstance(by_task, Mapping) else ()
    for above, sections in (
        ((), document),
        *(
            (("by_task", task), sections)
            for task, sections in tasks
            if isinstance(sections, Mapping)
        ),
    ):
        for name, (field, example) in not_set_in_sections().items():
            section = sections.get(name)
            model = model_at((name,))
            if (
                isinstance(section, Mapping)
                and field in section
                and model is not None
                and field in model.model_fields
            ):
                hint = f"write `{example}` at the top, outside every section"
                mistakes.append(
                    Finding((*above, name, field, KEY), f"'{field}' is not set here", hint)
                )
    return mistakes


def not_set_in_sections() -> dict[str, tuple[str, str]]:
    """Return, by section: the field that only the top of a spec may set, and how."""
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
    """Return one finding for each place: what pydantic says of the members of a union belongs
    together. A hint proposes no value that is not one of those that `accepts` takes.
    """
    by_place: dict[Loc, list[dict[str, Any]]] = {}
    for entry in error.errors(include_url=False):
        by_place.setdefault(_without_tags(entry["loc"], document), []).append(dict(entry))
    # pydantic counts the valid entries of a list only; that the others are wrong is said where they
    # stand.
    sections = {loc[:length] for loc in by_place for length in range(len(loc))}
    hollow = {
        loc
        for loc, entries in by_place.items()
        if entries[0]["type"] == "too_short" and loc in sections
    }
    meant = partial(proposal, document=document, accepts=accepts)
    return [
        _worded(loc, entries, key_hint, description, meant)
        for loc, entries in by_place.items()
        if loc not in hollow
    ]


def _without_tags(loc: Loc, document: Mapping[str, Any]) -> Loc:
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


_WORDS = {  # pydantic's words for what a YAML file holds, and ours
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
    meant: Callable[[Loc, list[dict[str, Any]]], Proposal | None],
) -> Finding:
    first = entries[0]
    kind = first["type"]
    context = first.get("ctx") or {}
    shown = _shown(first["input"])
    if kind == "extra_forbidden" and str(loc[-1]) in settings() and "." in str(loc[-1]):
        section, _, field = str(loc[-1]).rpartition(".")
        written = f"{field}: {first['input']}" if shown != "a mapping" else field
        hint = f"write `{written}` in the section '{section}'; names with dots are for --set"
        return Finding(loc, f"unknown key '{loc[-1]}'", hint, at_key=True)
    if kind == "extra_forbidden":
        return Finding(loc, f"unknown key '{loc[-1]}'", key_hint(loc), at_key=True)
    if kind == "missing":
        inside = f" in '{'.'.join(map(str, loc[:-1]))}'" if len(loc) > 1 else ""
        return Finding(
            loc,
            f"missing key '{loc[-1]}'{inside}" if loc[-1:] != (KEY,) else first["msg"],
            description(loc),
        )
    if "hint" in context or kind in ("repeated", "no_operator", "severity_range"):
        return Finding(
            loc,
            first["msg"] + (f", not {shown}" if kind == "severity_range" else ""),
            context.get("hint"),
        )
    if kind == "value_error":
        return Finding(loc, str(context["error"]), at_key=True)
    if kind in ("too_short", "string_too_short"):
        return Finding(loc, "should not be empty", description(loc))
    if any(entry["type"] == "string_pattern_mismatch" for entry in entries):
        hint = "letters, digits, dot, dash and underscore, beginning with a letter or a digit"
        return Finding(loc, f"{shown} is not a usable name", hint)
    message = " or ".join(
        dict.fromkeys(re.sub(r"^Input should ", "", entry["msg"]) for entry in entries)
    ).replace(" or be ", " or ")
    message = re.sub(r" or instance of \w+", "", message)  # a file holds no objects of Python
    for theirs, ours in _WORDS.items():
        message = message.replace(theirs, ours)
    if message.startswith(("be ", "have ", "match ")):
        message = f"should {message}"
    if shown not in message:
        message = f"{message}, not {shown}"
    proposed = meant(loc, entries)
    if proposed is None:
        return Finding(loc, message)
    return Finding(loc, message, proposed.hint, written=proposed.written)


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, list | tuple):
        return "a list"
    if value is None:
        return "nothing (null)"
    if isinstance(value, float) and value.is_integer():
        value = int(value)  # as it is written
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 40 else text[:37] + "..."
