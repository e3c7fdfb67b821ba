"""Entries of a spec's `tasks` that are mappings: each declares an environment.

A `Spec` has their names in `tasks` and their settings in `environments`. Mistakes are reported at
the place where the file has them, in `tasks`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, get_args

from pydantic import AfterValidator, ValidationError
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError
from pydantic_core.core_schema import ErrorType

from wasp_cli.tasks.declared import Declaration, declare
from wasp_cli.tasks.registry import TASKS, is_foreign

KEY = "[key]"  # how pydantic ends the place of a key
TASKS_KEY = "tasks"
FIELD = "environments"
Loc = tuple[str | int, ...]
Problem = tuple[Loc, PydanticCustomError, Any]
_UNIONS = {"cost": "dict[", "state": "tuple["}
"""Fields that are a text, or what has a tag that begins so."""


@dataclass(frozen=True)
class Apart:
    """A document whose entries of `tasks` are names."""

    document: dict[str, Any]
    entries: Mapping[str, int]  # place in `tasks` of what is declared, by name
    problems: tuple[Problem, ...]


def drawn_apart(document: Mapping[str, Any]) -> Apart:
    """Move the mappings in `tasks` to `environments`, and leave their names in `tasks`. The
    environments are declared, so that their names can be looked up.
    """
    problems: list[Problem] = []
    if FIELD in document:
        what = PydanticCustomError(
            "in_tasks", "a file has no '{key}'", {"key": FIELD, "hint": "write it in tasks"}
        )
        problems.append(((FIELD, KEY), what, FIELD))
    tasks = document.get(TASKS_KEY)
    if not isinstance(tasks, list):
        return Apart(dict(document), {}, tuple(problems))
    names: list[Any] = []
    declared: dict[str, Any] = {}
    entries: dict[str, int] = {}
    for number, entry in enumerate(tasks):
        if not isinstance(entry, Mapping):
            names.append(entry)
            continue
        name = _name(entry, number)
        if name in declared and dict(declared[name]) != dict(entry):
            what = PydanticCustomError(
                "declared_twice",
                "another environment is called '{name}' already",
                {"name": name, "hint": "give one of them another `name`"},
            )
            problems.append(((TASKS_KEY, number), what, entry))
        names.append(name)
        declared.setdefault(name, entry)
        entries.setdefault(name, number)
    for name in names:
        if isinstance(name, str):
            # replaces what an earlier spec has declared under this name
            declare(name, _read(declared[name]) if name in declared else None)
    return Apart({**document, TASKS_KEY: names, FIELD: declared}, entries, tuple(problems))


def _read(entry: Mapping[str, Any]) -> Declaration | None:
    """An entry as a declaration; None if something is wrong with it, which the spec reports."""
    try:
        return Declaration.model_validate_json(json.dumps(entry), strict=True)
    except ValidationError:
        return None


def _name(entry: Mapping[str, Any], number: int) -> str:
    """The name of an entry; if it has none, its number in words for messages."""
    for key in ("name", "id"):
        if isinstance(entry.get(key), str):
            return str(entry[key])
    return f"entry {number + 1}"


def placed(error: ValidationError, apart: Apart) -> ValidationError:
    """Return the same errors at the places of the file, with the problems that `drawn_apart` has
    found.
    """
    details = error.errors(include_url=False)
    wrong = {
        str(each["loc"][1]) for each in details if each["loc"][0] == FIELD and len(each["loc"]) > 1
    }
    moved: list[InitErrorDetails] = []
    for each in details:
        loc = each["loc"]
        if loc[0] == FIELD and len(loc) > 1:
            name = str(loc[1])
            below = _without_tag(loc[2:], apart.document[FIELD][name])
            if below is None:
                continue
            loc = (TASKS_KEY, apart.entries[name], *below)
        elif loc[:1] == (TASKS_KEY,) and len(loc) > 1 and each["input"] in wrong:
            continue  # the name is unknown only because its entry is wrong
        elif loc[0] == "by_task" and KEY in loc and str(each["input"]) in apart.entries:
            continue  # the same; it is reported at the entry
        elif each["type"] == "repeated" and loc == (TASKS_KEY,) and apart.problems:
            continue  # reported at the entry
        moved.append(_again(each, loc))
    for loc, what, value in apart.problems:
        moved.append(InitErrorDetails(type=what, loc=loc, input=value))
    return ValidationError.from_exception_data("Spec", moved)


def _without_tag(loc: Loc, entry: Mapping[str, Any]) -> Loc | None:
    """The place of an error in an entry, without pydantic's name for a member of a union.

    None if that member is of another kind than the value: such an error explains nothing.
    """
    if len(loc) < 2 or loc[0] not in _UNIONS:
        return loc
    written = entry.get(str(loc[0]))
    tag = ""
    if isinstance(written, dict):
        tag = "dict["
    elif isinstance(written, list):
        tag = "tuple["
    if tag and not str(loc[1]).startswith(tag):
        return None if tag == _UNIONS[str(loc[0])] else (loc[0],)
    return (loc[0], *loc[2:])


def _again(error: ErrorDetails, loc: Loc) -> InitErrorDetails:
    """An error as it can be raised again, at another place."""
    context = error.get("ctx", {})
    what: str | PydanticCustomError = error["type"]
    if error["type"] not in get_args(ErrorType):
        what = PydanticCustomError(error["type"], error["msg"], context)
    return InitErrorDetails(type=what, loc=loc, input=error["input"], ctx=context)


def _declared(environments: dict[str, Declaration]) -> dict[str, Declaration]:
    """Declare every environment, so that its name can be looked up."""
    problems: list[InitErrorDetails] = []
    for name, declaration in environments.items():
        wrong = _wrong_names(name, declaration)
        if wrong is not None:
            field, what = wrong
            value = getattr(declaration, field)
            problems.append(InitErrorDetails(type=what, loc=(name, field), input=value))
    if problems:
        raise ValidationError.from_exception_data("environments", problems)
    for name, declaration in environments.items():
        declare(name, declaration)
    return environments


def _wrong_names(name: str, declaration: Declaration) -> tuple[str, PydanticCustomError] | None:
    """What is wrong with the id or the name of an environment, and which of them."""
    if not is_foreign(declaration.id):
        hint = "write module:Id-v0, or an id that gymnasium knows"
        if declaration.id in TASKS:
            hint = f"'{declaration.id}' is a task of wasp: write its name alone"
        what = PydanticCustomError(
            "gymnasium_id",
            "'{id}' is no gymnasium id of others",
            {"id": declaration.id, "hint": hint},
        )
        return "id", what
    if declaration.name is None:
        return None
    if name in TASKS or (is_foreign(name) and name != declaration.id.rpartition(":")[2]):
        what = PydanticCustomError(
            "taken_name",
            "'{name}' is the name of another task",
            {"name": name, "hint": "give the environment another `name`"},
        )
        return "name", what
    return None


Environments = Annotated[dict[str, Declaration], AfterValidator(_declared)]
