"""Checked names: what a spec may write wherever it names a task, a method, a stage, an operator
variant or itself.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Annotated, Any

from pydantic import AfterValidator, Field, ValidationError, ValidationInfo
from pydantic_core import InitErrorDetails, PydanticCustomError

from wasp_cli.console import announced_if_slow
from wasp_cli.errors import UnknownName, WaspError, did_you_mean
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.registry import Registry
from wasp_cli.stages.registry import STAGES, stages_of
from wasp_cli.tasks.declared import DeclarationError
from wasp_cli.tasks.foreign.assets import declared_files
from wasp_cli.tasks.registry import TASKS, ForeignInfo, task_named

EXTENDS = "extends"
SHORT = "task"
TOP = (EXTENDS, SHORT)  # keys at the top of a file that are no fields of a spec
PATIENCE = 10.0
"""Seconds after which somebody who waits for code of others is told what the command waits for."""
RECORDED = "recorded"
"""Set in the context of a validation if the spec was run before: its environments need not be
installed to read it again.
"""


def unknown(kind: str, name: str, known: Iterable[str]) -> PydanticCustomError:
    """Return the error for a name that is not known; its context has a hint with similar names."""
    hint = did_you_mean(name, sorted(known))
    return PydanticCustomError(
        "unknown_name", "unknown {kind} '{name}'", {"kind": kind, "name": name, "hint": hint}
    )


def known(kind: str, names: Callable[[], Iterable[str]]) -> AfterValidator:
    """Return a validator that accepts only the names that `names` returns when it is called."""

    def check(name: str) -> str:
        allowed = list(names())
        if name not in allowed:
            raise unknown(kind, name, allowed)
        return name

    return AfterValidator(check)


def _usable(name: str, info: ValidationInfo, use: Callable[[], object]) -> str:
    if (info.context or {}).get(RECORDED):
        return name
    waiting = (
        f"loading '{name}' takes more than {PATIENCE:.0f} s. If it does not end, look at what its "
        "module, its constructor or its first steps wait for; Ctrl-C ends this command."
    )
    try:
        with announced_if_slow(waiting, PATIENCE):
            use()
    except WaspError as error:
        what = PydanticCustomError(
            "own", "{message}", {"message": error.message, "hint": error.hint or ""}
        )
        if isinstance(error, DeclarationError):  # it points at a line of the entry
            details = InitErrorDetails(type=what, loc=(error.field,), input=name)
            raise ValidationError.from_exception_data("task", [details]) from error
        raise what from error
    return name


def _task(name: str, info: ValidationInfo) -> str:
    with suppress(UnknownName):
        # Specs have one name for a task, since it names random streams and results.
        if name not in TASKS:
            registered = task_named(name)
            if registered in TASKS:
                raise PydanticCustomError(
                    "task",
                    "'{name}' is built in under another name",
                    {"name": name, "hint": f"write '{registered}'"},
                )
    _require(TASKS, name)
    return name if name in TASKS.own else _usable(name, info, lambda: _load_task(name))


def _load_task(name: str) -> None:
    """Check that a task of another package works, and that many of it can run side by side. Raises
    WaspError.
    """
    TASKS.load(name)
    task = TASKS[name]
    if isinstance(task, ForeignInfo):
        task.require_independent()


def _require(registry: Registry[Any], name: str) -> None:
    try:
        registry[name]
    except UnknownName as error:
        context = {"message": error.message, "hint": error.hint or ""}
        raise PydanticCustomError("unknown_name", "{message}", context) from error


def _registered(registry: Registry[Any]) -> AfterValidator:
    def check(name: str, info: ValidationInfo) -> str:
        _require(registry, name)
        # The code of others is loaded now: it should not fail after the training.
        return name if name in registry.own else _usable(name, info, lambda: _load(registry, name))

    return AfterValidator(check)


def _load(registry: Registry[Any], name: str) -> None:
    """Import an entry that is not ours, and see that its `needs` are listed and its `assets` are
    there; WaspError where they are not.
    """
    loaded = registry.load(name)
    needs = getattr(loaded, "needs", ())
    if not isinstance(needs, (tuple, list)):
        raise WaspError(
            f"`needs` of '{name}' is {needs!r}, no tuple of stages",
            'write it as in needs = ("critics",)',
        )
    assets = getattr(loaded, "assets", None)
    if assets is not None:
        declared_files(assets, [loaded.__module__], f"'{name}'")


def training_stages() -> list[str]:
    """Return the stages that a spec may list under `stages`, in registry order."""
    return list(stages_of("chain", "cell"))


def _stage(name: str) -> str:
    if name not in STAGES:
        raise unknown("stage", name, training_stages())
    elsewhere = {
        "method": "list its method under `methods`",
        "operator": "write `auto` in the place of a severity under `operators`",
        "person": "wasp clone RESULTS --participant N makes it",
    }
    unit = STAGES[name].unit
    hint = elsewhere.get(unit)
    if hint:
        whom = f"an {unit}" if unit == "operator" else f"a {unit}"
        raise PydanticCustomError(
            "elsewhere", "'{name}' runs for {whom}", {"name": name, "whom": whom, "hint": hint}
        )
    return name


def assistant_variants() -> list[str]:
    """Return every ablation of every method, in registry order, without repeats."""
    return list(
        dict.fromkeys(variant for method in METHODS.values() for variant in method.variants)
    )


def _no_repeats(items: Sequence[Any]) -> Sequence[Any]:
    for item in items:
        if items.count(item) > 1:
            raise PydanticCustomError("repeated", "'{item}' is listed twice", {"item": str(item)})
    return items


NO_REPEATS = AfterValidator(_no_repeats)

# The names of specs become folders and those of severities parts of file names, hence the narrow
# alphabets.
LONGEST = 64
SpecName = Annotated[str, Field(pattern=rf"^[A-Za-z0-9][A-Za-z0-9_.-]{{0,{LONGEST - 1}}}$")]
SeverityName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,31}$")]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
TaskName = Annotated[str, AfterValidator(_task)]
MethodName = Annotated[str, _registered(METHODS)]
VariantName = Annotated[str, known("assistant variant", assistant_variants)]
StageName = Annotated[str, AfterValidator(_stage)]
OperatorName = Annotated[str, _registered(OPERATORS)]


def spec_name(head: str, tail: str, taken: Iterable[str] = ()) -> str:
    """Return `head-tail` as a valid name of at most LONGEST characters: other characters become
    dashes, `head` is cut, and a number is added if the name is in `taken`.
    """
    others = set(taken)
    clean = re.sub(r"[^A-Za-z0-9_.-]+", "-", tail)[:48].rstrip("-")
    end = f"-{clean}"
    number = 1
    while True:
        name = head[: LONGEST - len(end)] + end
        if name not in others:
            return name
        number += 1
        end = f"-{clean}-{number}"
