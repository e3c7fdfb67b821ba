"""The specification of an experiment: what a YAML file in `specs/` says, validated and frozen.

The sections of the stages and of the methods come from the registries, so that a new one needs no
line here.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    Field,
    ValidationError,
    ValidationInfo,
    create_model,
    model_validator,
)
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError
from pydantic_core.core_schema import ErrorType

from wasp_cli.config import Config, assumed
from wasp_cli.errors import WaspError
from wasp_cli.learning.configs.shared import ReturnsConfig
from wasp_cli.methods.registry import METHODS, Knob
from wasp_cli.metrics.severity import AUTO
from wasp_cli.operators.registry import OPERATORS, PERSON, UNIMPAIRED
from wasp_cli.registry import Entry, Registry
from wasp_cli.spec import names
from wasp_cli.spec.environments import FIELD as ENVIRONMENTS
from wasp_cli.spec.environments import Environments, drawn_apart, placed
from wasp_cli.spec.names import NO_REPEATS, RECORDED, TOP, unknown
from wasp_cli.spec.own_units import with_auto
from wasp_cli.spec.presets import merged, preset_values
from wasp_cli.spec.study import StudyConfig
from wasp_cli.stages.registry import STAGES, StageInfo
from wasp_cli.tasks.declared import USUAL_CONTROLS, declare
from wasp_cli.tasks.registry import TASKS, ForeignInfo

Preset = Literal["smoke", "quick", "cpu", "gpu", "paper"]
Severity = float | Literal["auto"]
Severities = Annotated[dict[names.SeverityName, Severity], Field(min_length=1)]
# where, what, and the value that is wrong
Problem = tuple[tuple[str | int, ...], PydanticCustomError, Any]
DEFAULT_STAGES: tuple[str, ...] = tuple(
    kind for kind, info in STAGES.own.items() if info.by_default
)
"""What every spec trains besides what its methods need."""


def refuse(problems: list[Problem]) -> None:
    """Raise one ValidationError with every problem at its own place, if there are any. A ValueError
    would point at the whole section.
    """
    if problems:
        errors = [
            InitErrorDetails(type=what, loc=where, input=value) for where, what, value in problems
        ]
        raise ValidationError.from_exception_data("Spec", errors)


def _usable_severities(operators: dict[str, dict[str, Severity]]) -> dict[str, dict[str, Severity]]:
    problems: list[Problem] = []
    for variant, severities in operators.items():
        first: str | None = None  # the severity that is `auto`
        for severity, value in severities.items():
            if isinstance(value, str):
                wrong = _no_auto(variant, first)
                first = first or severity
            else:
                wrong = _out_of_range(variant, value)
            if wrong is not None:
                problems.append(((variant, severity), wrong, value))
    refuse(problems)
    return operators


def _no_auto(variant: str, other: str | None) -> PydanticCustomError | None:
    """Why a severity cannot be `auto`; None if it can.

    Args:
        other: name of another severity of the operator that is `auto`.
    """
    if not OPERATORS[variant].simulated:
        hint = f"write {OPERATORS[variant].unit}"
        message = "'auto' is for the severity of a simulated operator"
        return PydanticCustomError("auto_person", message, {"hint": hint})
    if other is None:
        return None
    context = {"other": other, "variant": variant, "hint": "write a number for one of them"}
    message = "'{other}' of '{variant}' is auto too: both would be the same severity"
    return PydanticCustomError("auto_twice", message, context)


def _out_of_range(variant: str, value: float) -> PydanticCustomError | None:
    info = OPERATORS[variant]
    if info.low <= value <= info.high:
        return None
    context = {"low": f"{info.low:g}", "high": f"{info.high:g}", "unit": info.unit}
    return PydanticCustomError(
        "severity_range", "should lie between {low} and {high} ({unit})", context
    )


class Spec(Config):
    """What to run. Sections of stages and methods are fields of the subclass that `spec_type`
    builds.
    """

    name: names.SpecName = Field(description="name of the reports; not part of any key")
    preset: Preset = Field(
        default="cpu", description="sets every size and budget; values in this file override it"
    )
    # Before `tasks`: their names are looked up by what is declared here.
    environments: Environments = Field(
        default={},
        description="the entries of `tasks` that are mappings, by name; a file writes them there",
    )
    tasks: Annotated[
        tuple[names.TaskName, ...], NO_REPEATS, Field(min_length=1, description="the tasks")
    ]
    methods: Annotated[
        tuple[names.MethodName, ...], NO_REPEATS, Field(description="the assistants")
    ]
    stages: Annotated[tuple[names.StageName, ...], NO_REPEATS] = Field(
        default=DEFAULT_STAGES,
        description="what is computed besides what the methods need: training once for each task "
        "and seed of training, `counterfactual` for each cell whose method may intervene",
    )
    variants: Annotated[tuple[names.VariantName, ...], NO_REPEATS, Field(min_length=1)] = Field(
        default=("full",),
        description="ablations of the methods that have them; the others run once",
    )
    operators: Annotated[
        dict[names.OperatorName, Severities], AfterValidator(_usable_severities)
    ] = Field(
        default={},
        description="operator variants with their severities, as name: value; auto: chosen on "
        "held-out worlds, see `severity`",
    )
    seeds: Annotated[
        tuple[names.Seed, ...], NO_REPEATS, Field(min_length=1, description="evaluation seeds")
    ]
    training_seed: names.Seed | None = Field(
        default=None,
        description="null: every seed trains its own models; a number: all share the models of "
        "that seed",
    )
    episodes: int = assumed(30, "episodes per cell and seed", ge=1, le=100_000)
    side_by_side: int = assumed(
        10,
        "episodes of a cell in one batch; rounding may depend on their number, so that "
        "only whole batches are taken over",
        ge=1,
    )
    action_repeat: int = assumed(4, "env steps per decision step", ge=1)
    returns: ReturnsConfig = ReturnsConfig()
    by_task: dict[names.TaskName, dict[str, dict[str, Any]]] = Field(
        default={},
        description="settings that one task has of its own, over those of the sections, as task: "
        "{section: {field: value}}",
    )
    operating_points: Literal["auto", "chosen", "given"] = Field(
        default="auto",
        description="chosen: each assistant is evaluated at the value of its knob that was best on "
        "held-out worlds, or is silent where none helped; given: at the values of its section; "
        "auto: chosen on tasks of one's own, given on those of this package",
    )
    by_hand: dict[names.TaskName, tuple[names.MethodName, ...]] | None = Field(
        default=None,
        description="by task, the assistants that keep the values of their sections although "
        "operating points are chosen; null: those whose knob the spec writes",
    )
    study: StudyConfig | None = Field(
        default=None,
        description="of people who drive the cells with `wasp drive SPEC`; not part of any key",
    )
    reuse: Literal["none", "published"] = Field(
        default="none",
        description="published: results in results/published with the same configuration are used "
        "instead of computed, even if the code has changed since; not part of any key",
    )

    def stage(self, kind: str, task: str | None = None) -> Config:
        """Return the section of a stage, with the settings that `task` has of its own over it."""
        return _over(getattr(self, kind), self.by_task.get(task or "", {}).get(kind))

    def method(self, name: str, variant: str = "full", task: str | None = None) -> Config:
        """Return the section of a method with a variant set, with the settings that `task` has of
        its own over it. For a class of one's own, which has no section, it is the default
        configuration.

        Raises:
            ValidationError: the variant asks for more of other fields than the section has.
        """
        info = METHODS[name]
        section: Config = info.config_model()()
        if name in method_sections():
            section = _over(getattr(self, name), self.by_task.get(task or "", {}).get(name))
        if len(info.variants) > 1:
            # Validated again, since a variant may ask for more of the other fields than the section
            # did.
            section = type(section).model_validate({**section.model_dump(), "variant": variant})
        return section

    def variants_of(self, method: str) -> tuple[str, ...]:
        """Return the variants of a method that this spec asks for. A method without ablations has
        one.
        """
        known = tuple(METHODS[method].variants)
        if len(known) == 1:
            return known
        return tuple(variant for variant in self.variants if variant in known)

    def chooses_point(self, task: str, method: str) -> bool:
        """Return whether the operating point of a method on a task is chosen on held-out worlds. It
        is not if the method never intervenes, or the spec sets its knob.
        """
        if not METHODS[method].intervenes or method in (self.by_hand or {}).get(task, ()):
            return False
        if self.operating_points == "auto":
            return task not in TASKS.own
        return self.operating_points == "chosen"

    def knob(self, task: str, method: str) -> Knob | None:
        """Return the knob of a method with the values that are tried on a task; None if it has
        none.
        """
        knob = METHODS[method].knob
        if knob is None:
            return None
        asked: Mapping[str, list[float]] = self.stage("operating", task).model_dump()["values"]
        return replace(knob, values=tuple(asked.get(method, knob.values)))

    @property
    def chooses_severities(self) -> bool:
        """Whether the severity of any operator is chosen on held-out worlds."""
        return any(AUTO in severities.values() for severities in self.operators.values())

    def repeat_of(self, task: str) -> int:
        """Return the env steps of a decision on a task."""
        environment = self.environments.get(task)
        own = None if environment is None else environment.action_repeat
        return self.action_repeat if own is None else own

    def declare_tasks(self) -> None:
        """Declare the environments of this spec in this process, so that its tasks can be made by
        name.
        """
        for task in self.tasks:
            declare(task, self.environments.get(task))

    def chain_seed(self, seed: int) -> int:
        """Return the training seed whose models an evaluation seed uses."""
        return seed if self.training_seed is None else self.training_seed

    @model_validator(mode="after")
    def _parts_fit(self, info: ValidationInfo) -> Spec:
        refuse(
            _list_problems(self, recorded=bool((info.context or {}).get(RECORDED)))
            + _skill_problems(self)
            + _knob_problems(self)
            + _controls_problems(self, recorded=bool((info.context or {}).get(RECORDED)))
        )
        _check_tasks(self)
        _check_variants(self)
        return self


def _over(section: Config, values: Mapping[str, Any] | None) -> Config:
    """A section with some values of a task over its own."""
    if not values:
        return section
    return type(section).model_validate_json(
        json.dumps(merged(section.model_dump(mode="json"), values)), strict=True
    )


EVERYWHERE = ("evaluate", "counterfactual", "expert.checkpoints")
"""Sections and settings that are the same for all tasks: tables compare cells, and operators
name skills.
"""


def _check_tasks(spec: Spec) -> None:
    """Raise ValidationError for settings of single tasks that are wrong or the same for all."""
    sections = [name for name in (*STAGES, *method_sections()) if name not in EVERYWHERE]
    errors: list[InitErrorDetails] = []
    for task, changes in spec.by_task.items():
        for name, values in changes.items():
            here = ("by_task", task, name)

            # Settings that are the same for all tasks: the section itself, or some of its fields.
            places = {name: ("[key]",)} | {f"{name}.{field}": (field, "[key]") for field in values}
            shared = [*EVERYWHERE, *(f"{kind}.operators" for kind in mixing_stages())]
            same = [key for key in places if key in shared]
            for key in same:
                hint = {"key": key, "hint": f"set '{key}' outside `by_task`"}
                what = PydanticCustomError("everywhere", "'{key}' is the same for all tasks", hint)
                errors.append(InitErrorDetails(type=what, loc=(*here, *places[key]), input=key))
            if same:
                continue

            # Sections that do not exist, and values that the section does not take.
            if name not in sections:
                what = unknown("section", name, sections)
                errors.append(InitErrorDetails(type=what, loc=(*here, "[key]"), input=name))
                continue
            try:
                _over(getattr(spec, name), values)
            except ValidationError as error:
                errors += [_moved(problem, here) for problem in error.errors(include_url=False)]
    if errors:
        raise ValidationError.from_exception_data("Spec", errors)


def _check_variants(spec: Spec) -> None:
    """Validate every variant that runs, since one may ask for more than its section does."""
    for name in spec.methods:
        if len(METHODS[name].variants) == 1:
            continue
        for variant, task in product(spec.variants_of(name), ("", *spec.by_task)):
            try:
                spec.method(name, variant, task)
            except ValidationError as error:
                errors = [_moved(problem, (name,)) for problem in error.errors(include_url=False)]
                raise ValidationError.from_exception_data("Spec", errors) from error


def _moved(error: ErrorDetails, under: tuple[str | int, ...]) -> InitErrorDetails:
    """An error of a section, below a place of the spec."""
    context = error.get("ctx", {})
    what: str | PydanticCustomError = error["type"]
    if error["type"] not in get_args(ErrorType):
        what = PydanticCustomError(error["type"], error["msg"], context)
    return InitErrorDetails(
        type=what, loc=(*under, *error["loc"]), input=error["input"], ctx=context
    )


def _list_problems(spec: Spec, *, recorded: bool) -> list[Problem]:
    """Lists that do not fit each other. A spec that ran before (`recorded`) may have lost all of
    its methods with a plugin, or have variants of methods that were left out.
    """
    problems: list[Problem] = []
    trains = any(STAGES[kind].unit == "chain" for kind in spec.stages)
    if not recorded and not spec.methods and not trains:
        hint = {"hint": "name a method, or under `stages` what is to be trained"}
        what = PydanticCustomError("nothing", "neither methods nor stages are listed", hint)
        problems.append((("methods",), what, []))
    offered = {variant for method in spec.methods for variant in METHODS[method].variants}
    offered = offered or {"full"}  # without methods: the default of `variants`
    for index, variant in enumerate(spec.variants):
        if variant not in offered and not recorded:
            what = unknown("variant of the listed methods", variant, offered)
            problems.append((("variants", index), what, variant))
    if not spec.operators and any(METHODS[method].impaired for method in spec.methods):
        message = "the listed methods assist an operator; name at least one variant"
        problems.append((("operators",), PydanticCustomError("no_operator", message, {}), None))
    return problems


def _skill_problems(spec: Spec) -> list[Problem]:
    """Limited skills that are no checkpoint of the expert, and operators that stages drive with
    which do not exist.
    """
    checkpoints: tuple[float, ...] = getattr(spec, "expert").checkpoints  # noqa: B009  (a field of the built subclass)
    hint = "checkpoints: " + ", ".join(f"{share:g}" for share in checkpoints)
    what = PydanticCustomError(
        "no_checkpoint", "no such value in expert.checkpoints", {"hint": hint}
    )
    # `auto` chooses an earlier checkpoint than the last one.
    problems: list[Problem] = [
        (("operators", "limited-skill", severity), what, value)
        for severity, value in spec.operators.get("limited-skill", {}).items()
        if value not in checkpoints and (value != AUTO or len(checkpoints) < 2)
    ]
    for section in mixing_stages():
        mixed: dict[str, tuple[float, ...]] = getattr(spec, section).operators
        for variant, values in mixed.items():
            if variant not in OPERATORS:
                problems.append(
                    (
                        (section, "operators", variant, "[key]"),
                        unknown("operator variant", variant, OPERATORS),
                        variant,
                    )
                )
                continue
            for index, value in enumerate(values):
                wrong = _out_of_range(variant, value)
                if wrong is None and variant == "limited-skill" and value not in checkpoints:
                    wrong = what
                if wrong is not None:
                    problems.append(((section, "operators", variant, index), wrong, value))
    return problems


def _knob_problems(spec: Spec) -> list[Problem]:
    """Values of knobs for assistants that have none, or that are listed twice."""
    section = "operating"
    places: list[tuple[tuple[str, ...], Mapping[str, Any]]] = [
        ((section, "values"), getattr(spec, section).values)
    ]
    for task, sections in spec.by_task.items():
        own = sections.get(section, {}).get("values")
        if isinstance(own, Mapping):  # what has another form is reported elsewhere
            places.append((("by_task", task, section, "values"), own))
    with_knob = [name for name, info in METHODS.items() if info.knob is not None]
    problems: list[Problem] = []
    for place, by_method in places:
        for method, values in by_method.items():
            if method not in with_knob:
                what = unknown("assistant with a knob", method, with_knob)
                problems.append(((*place, method, "[key]"), what, method))
            if not isinstance(values, list | tuple):
                continue
            for index, value in enumerate(values):
                if value in values[:index]:
                    what = PydanticCustomError("repeated", "the value is listed twice", {})
                    problems.append(((*place, method, index), what, value))
    return problems


def _controls_problems(spec: Spec, recorded: bool) -> list[Problem]:
    """Environments that people drive and whose spec does not say which key commands which number.

    A spec that was run before has none: its environments need not be installed.
    """
    if recorded:
        return []
    drives = PERSON in spec.operators
    problems: list[Problem] = []
    for index, task in enumerate(spec.tasks):
        declared = spec.environments.get(task)
        controls = None if declared is None else declared.controls
        info = TASKS[task]
        if not isinstance(info, ForeignInfo) or (controls is None and not drives):
            continue
        size = info.action_size
        example = ", ".join([*("right", "up"), *["none"] * size][:size])
        context = {"size": size, "hint": f"write one for each, as in controls: [{example}]"}
        if controls is not None and len(controls) != size:
            text = "{count} controls, and an action has {size} numbers"
            what = PydanticCustomError("controls", text, {**context, "count": len(controls)})
            problems.append(((ENVIRONMENTS, task, "controls"), what, controls))
        if controls is None and size not in USUAL_CONTROLS:
            text = "a person cannot drive it: its entry has no keys for its {size} numbers"
            what = PydanticCustomError("controls", text, context)
            place = ("tasks", index) if declared is None else (ENVIRONMENTS, task, "id")
            problems.append((place, what, task))
    return problems


def method_sections() -> list[str]:
    """Return the methods that have a section of a spec: all but those whose name is also a
    stage's.
    """
    return [name for name in METHODS if name not in STAGES]


@cache
def mixing_stages() -> tuple[str, ...]:
    """Return the stages that drive the task with operators of their own choice: their section has a
    field `operators`.
    """
    return tuple(kind for kind in STAGES if "operators" in STAGES.load(kind).config.model_fields)


@cache
def spec_type() -> type[Spec]:
    """Return the model of a spec with a section for each stage and method, of plugins too. Raises
    WaspError if a plugin's entry does not fit (`check_plugin`).
    """
    for registry in (STAGES, METHODS, OPERATORS):
        for name in set(registry) - set(registry.own):
            made = registry.load(name) if registry is STAGES else None
            check_plugin(registry, registry[name], made)
    models: dict[str, type[Config]] = {kind: STAGES.load(kind).config for kind in STAGES}
    models |= {name: METHODS[name].config_model() for name in method_sections()}
    fields: dict[str, Any] = {
        name: (model, Field(default_factory=model)) for name, model in models.items()
    }
    return create_model("Spec", __base__=Spec, __doc__=Spec.__doc__, **fields)


def check_plugin(registry: Registry[Any], entry: Entry, made: Any) -> None:
    """Raise WaspError if a plugin's entry has a name that means something else in a spec, or is a
    stage (`made`: its class) that has no place in a plan.
    """
    # Names that mean something else, each with its meaning. Stages and methods share their names
    # with their sections.
    taken: dict[str, str] = {}
    if registry is OPERATORS:
        taken[UNIMPAIRED] = "the unimpaired expert"
    other: Registry[Any] | None = None
    if registry is STAGES:
        other = METHODS
    elif registry is METHODS:
        other = STAGES
    if other is not None:
        added = [getattr(plugin, "name", "") for _, plugin in other.plugins()]
        taken |= dict.fromkeys((*other.own, *added), f"a {other.kind}")
        taken |= dict.fromkeys((*Spec.model_fields, *TOP), "a field of every spec")
    if entry.name in taken:
        message = (
            f"the {registry.kind} '{entry.name}' of a plugin has the name of {taken[entry.name]}"
        )
        raise WaspError(message, "rename it in the plugin, or uninstall the plugin")
    if not isinstance(entry, StageInfo):
        return
    if entry.unit != "chain":
        raise WaspError(
            f"the stage '{entry.name}' of a plugin has unit '{entry.unit}'",
            "stages of plugins have the unit 'chain'",
        )
    section = getattr(made, "config", None)
    if not (isinstance(section, type) and issubclass(section, Config)):
        raise WaspError(
            f"the class of stage '{entry.name}' has no `config` that derives from "
            "wasp_cli.config.Config",
            "repair the plugin",
        )
    others = {*STAGES} - {entry.name}
    fields = {*Spec.model_fields}
    for name, known, what in (
        ("needs", others, "other stages"),
        ("settings", fields, "fields of a spec"),
    ):
        listed = getattr(made, name, None)
        if not isinstance(listed, tuple) or not set(listed) <= known:
            raise WaspError(
                f"`{name}` of stage '{entry.name}' is not a tuple of names of {what}: {listed!r}",
                "repair the plugin",
            )


def validate(document: Mapping[str, Any]) -> Spec:
    """Return the spec that a document says, over its preset.

    Args:
        document: the values of the files and options, as JSON values.

    Raises:
        ValidationError: with every mistake, at its place in the document.
    """
    # The document over its preset, with environments apart from the names of tasks.
    preset = document.get("preset", "cpu")
    below = preset_values(preset) if isinstance(preset, str) else {}
    resolved = _with_episodes(merged(below, document))
    apart = drawn_apart(resolved)

    # Strict JSON: "4" and true are not numbers, but a list is a tuple and 1 is a float.
    try:
        spec = spec_type().model_validate_json(json.dumps(apart.document), strict=True)
    except ValidationError as error:
        raise placed(error, apart) from None
    refuse(list(apart.problems))

    # What follows from what the document leaves open. The record of a run has it already.
    if spec.by_hand is None:
        settings = with_auto(spec.tasks, spec.methods, spec.by_task, document)
        hand = _written_knobs(spec, document)
        spec = spec.model_copy(update={"by_hand": hand, "by_task": settings})
    return spec


def _written_knobs(spec: Spec, document: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """By task, the methods whose knob a document sets. Values of a preset do not count."""
    by_task: dict[str, tuple[str, ...]] = {}
    for task in spec.tasks:
        sections = (document, spec.by_task.get(task, {}))
        written = [name for name in METHODS if any(_writes_knob(part, name) for part in sections)]
        if written:
            by_task[task] = tuple(written)
    return by_task


def _writes_knob(sections: Mapping[str, Any], method: str) -> bool:
    knob = METHODS[method].knob
    section = sections.get(method)
    return (
        knob is not None
        and isinstance(section, Mapping)
        and not set(knob.written).isdisjoint(section)
    )


def _with_episodes(document: dict[str, Any]) -> dict[str, Any]:
    """`episodes` at the top is the canonical spelling; the section of `evaluate` follows it."""
    section = document.get("evaluate", {})
    default = Spec.model_fields["episodes"].default
    if not isinstance(section, dict):
        return document
    if "episodes" in section and "episodes" not in document:
        return {**document, "episodes": section["episodes"]}
    episodes = document.get("episodes", default)
    usable = type(episodes) is int and episodes >= 1  # a wrong value is reported once, at the top
    return {**document, "evaluate": {**section, "episodes": episodes if usable else default}}
