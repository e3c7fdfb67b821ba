"""A spec file to a `Spec`, or to all of its problems at once."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from wasp_cli.errors import did_you_mean
from wasp_cli.spec.model import Spec, method_sections, spec_type, validate
from wasp_cli.spec.overrides import Override, apply, override
from wasp_cli.spec.problem import InvalidSpec, Problem
from wasp_cli.spec.read import Source, plain, read
from wasp_cli.spec.where import KEY, Loc, locate


@dataclass(frozen=True)
class Loaded:
    """A valid spec and where it came from."""

    spec: Spec
    source: Source
    overrides: tuple[Override, ...] = ()

    def problem(self, loc: Loc, message: str, hint: str | None = None) -> InvalidSpec:
        """A refusal that points at a place of this spec, for what only later steps can know."""
        return InvalidSpec([_placed(self.source, self.overrides, loc, message, hint)])


def load(path: Path, settings: Sequence[str] = ()) -> Loaded:
    """Read and validate a spec file under `--set` options.

    Args:
        path: the YAML file.
        settings: texts `a.b=value`, validated as if they stood in the file.

    Raises:
        InvalidSpec: with every problem, each with file, line and column.
        UsageError: a setting is not of the form `a.b=value`.
    """
    overrides = tuple(override(number, text) for number, text in enumerate(settings, start=1))
    return loaded(read(path), overrides)


def loaded(source: Source, overrides: Sequence[Override] = ()) -> Loaded:
    """Validate the document of a source."""
    document, problems = plain(source)
    document, problem = _listed(source, document)
    problems += problem
    document = apply(document, overrides)
    seen = {problem.position for problem in problems}

    def add(loc: Loc, message: str, hint: str | None = None, *, at_key: bool = False) -> None:
        problem = _placed(source, overrides, loc, message, hint, at_key=at_key)
        if problem.position is None or problem.position not in seen:
            problems.append(problem)

    for loc, message, hint in _misplaced(document):
        add(loc, message, hint)
    spec: Spec | None = None
    try:
        spec = validate(document)
    except ValidationError as error:
        for loc, message, hint, at_key in _readable(error, document):
            add(loc, message, hint, at_key=at_key)
    if problems or spec is None:
        raise InvalidSpec(problems)
    return Loaded(spec, source, tuple(overrides))


def _listed(source: Source, document: dict[str, Any]) -> tuple[dict[str, Any], list[Problem]]:
    """`task: a` is a short way to write `tasks: [a]`."""
    if "task" not in document:
        return document, []
    rest = {name: value for name, value in document.items() if name != "task"}
    if "tasks" in document:
        return rest, [source.problem(("task", KEY), "'task' beside 'tasks'", "write one of them", at_key=True)]
    if isinstance(document["task"], list):
        return rest | {"tasks": document["task"]}, [source.problem(("task",), "should be one name, not a list", "write tasks: [...]")]
    return rest | {"tasks": [document["task"]]}, []


def _placed(source: Source, overrides: Sequence[Override], loc: Loc, message: str, hint: str | None, *, at_key: bool = False) -> Problem:
    if loc[:1] == ("tasks",) and "task" in source.document and not any(option.path[0] == "tasks" for option in overrides):
        loc = ("task",)  # as the file has it
    _, depth = locate(source.document, loc)
    for option in reversed(overrides):
        shared = min(len(option.path), len(loc))
        # The option wins where the file has nothing nearer to the place.
        if tuple(map(str, loc[:shared])) == option.path[:shared] and shared >= min(depth, len(option.path)):
            return Problem(f"{option.option} {option.text}", None, f"{_dotted(loc)}: {message}" if loc else message, hint)
    return source.problem(loc, message, hint, at_key=at_key)


def _dotted(loc: Loc) -> str:
    return ".".join(str(part) for part in loc if part != KEY)


def _misplaced(document: Mapping[str, Any]) -> list[tuple[Loc, str, str | None]]:
    """What sections have as fields, and specs say at the top."""
    found: list[tuple[Loc, str, str | None]] = []
    sections = {"evaluate": ("episodes", "episodes: 30")} | dict.fromkeys(method_sections(), ("variant", "variants: [full]"))
    for name, (field, example) in sections.items():
        section, model = document.get(name), _model_at((name,))
        if isinstance(section, Mapping) and field in section and model is not None and field in model.model_fields:
            found.append(((name, field, KEY), f"'{field}' is not set here", f"write `{example}` at the top, outside every section"))
    return found


def _readable(error: ValidationError, document: Mapping[str, Any]) -> list[tuple[Loc, str, str | None, bool]]:
    """One entry for each place: what pydantic says of the members of a union belongs together."""
    found: dict[Loc, list[dict[str, Any]]] = {}
    for entry in error.errors(include_url=False):
        loc = _without_tags(entry["loc"], document)
        found.setdefault(loc, []).append({**entry, "loc": loc})
    return [(loc, *_wording(loc, entries)) for loc, entries in found.items()]


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


_WORDS = {
    "an object": "a mapping of keys to values",
    "a valid dictionary": "a mapping of keys to values",
    "a valid array": "a list",
    "a valid integer": "an integer",
    "a valid ": "a ",
}
"""pydantic's words for what a YAML file holds, and ours."""


def _wording(loc: Loc, entries: list[dict[str, Any]]) -> tuple[str, str | None, bool]:
    first = entries[0]
    context = first.get("ctx") or {}
    name = str(loc[-1]) if loc else ""
    if first["type"] == "extra_forbidden":
        return f"unknown key '{name}'", _key_hint(loc), True
    if first["type"] == "missing":
        return (f"missing key '{name}'" if loc[-1:] != (KEY,) else first["msg"]), _description(loc), False
    if "hint" in context or first["type"] in ("repeated", "no_operator", "severity_range"):
        value = "" if first["type"] != "severity_range" else f", not {_shown(first['input'])}"
        return first["msg"] + value, context.get("hint"), False
    if first["type"] == "value_error":
        return str(context["error"]), None, True
    if first["type"] in ("too_short", "string_too_short"):
        return "should not be empty", _description(loc), False
    message = " or ".join(dict.fromkeys(re.sub(r"^Input should ", "", entry["msg"]) for entry in entries)).replace(" or be ", " or ")
    for theirs, ours in _WORDS.items():
        message = message.replace(theirs, ours)
    shown = _shown(first["input"])
    if any(entry["type"] == "string_pattern_mismatch" for entry in entries):
        return f"{shown} is not a usable name", "letters, digits, dot, dash and underscore, beginning with a letter or a digit", False
    message = f"should {message}" if message.startswith(("be ", "have ", "match ")) else message
    return f"{message}, not {shown}" if shown not in message else message, _value_hint(first, entries), False


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, list | tuple):
        return "a list"
    if value is None:
        return "nothing (null)"
    text = repr(value) if isinstance(value, str) else str(value).lower() if isinstance(value, bool) else str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _value_hint(first: Mapping[str, Any], entries: list[dict[str, Any]]) -> str | None:
    allowed = [name for entry in entries if entry["type"] == "literal_error" for name in re.findall(r"'([^']*)'", entry["ctx"]["expected"])]
    return did_you_mean(first["input"], allowed) if allowed and isinstance(first["input"], str) else None


def _model_at(loc: Loc) -> type[BaseModel] | None:
    model: type[BaseModel] = spec_type()
    for part in loc:
        field = model.model_fields.get(str(part))
        if field is None or not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
            return None
        model = field.annotation
    return model


def _key_hint(loc: Loc) -> str:
    """Close keys of the same section, or the section that has the key."""
    name, model = str(loc[-1]), _model_at(loc[:-1])
    known = list(model.model_fields) if model is not None else []
    hint = did_you_mean(name, known)
    if hint.startswith("did you mean"):
        return hint
    if len(loc) > 1 and name in spec_type().model_fields:
        return f"'{name}' stands at the top, outside every section"
    models = {section: _model_at((section,)) for section in spec_type().model_fields}
    sections = [section for section, model in models.items() if model is not None and name in model.model_fields]
    if sections:
        return "did you mean " + " or ".join(f"'{section}.{name}'" for section in sections[:3]) + "?"
    return hint


def _description(loc: Loc) -> str | None:
    model = _model_at(loc[:-1])
    field = model.model_fields.get(str(loc[-1])) if model is not None else None
    return field.description if field is not None else None
