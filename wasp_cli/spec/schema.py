"""The JSON Schema of a spec, for editors: they complete keys and names, show what they mean, and mark what is wrong.

Built-in names alone unless plugins are asked for, so that the file in `specs/` is the same on every machine. A schema cannot say all that
the models check (limits of severities, what depends on several keys): `wasp check` has the last word.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.registry import Registry
from wasp_cli.spec.hints import not_set_in_sections
from wasp_cli.spec.load import SUFFIX
from wasp_cli.spec.model import EVERYWHERE, method_sections, mixing_stages, spec_type
from wasp_cli.spec.names import EXTENDS, SHORT, assistant_variants, training_stages
from wasp_cli.spec.presets import PRESETS, preset_values
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.reached import reached
from wasp_cli.tasks.registry import TASKS

DIALECT = "https://json-schema.org/draft/2020-12/schema"
MARKS = ("in_key", "in_paper")
"""What the models say to reports, and no validator knows."""
FOREIGN = r"^(?!(wasp_cli\.tasks\.gym:)?wasp/)(?=.*[:/]|.*-v[0-9]+$)([A-Za-z_][A-Za-z0-9_.]*:)?[A-Za-z0-9_./-]{1,100}$"
"""`tasks.registry.is_foreign` as a pattern."""
Schema = dict[str, Any]


class _Untitled(GenerateJsonSchema):
    """Without a title for each field, which would repeat its name."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def spec_schema(*, plugins: bool = False) -> Schema:
    """Return the schema of a spec file.

    Args:
        plugins: also the tasks, methods, operators and stages of installed plugins.
    """
    schema = spec_type().model_json_schema(schema_generator=_Untitled)
    definitions, top = schema["$defs"], schema["properties"]
    for model in definitions.values():
        _cleaned(model["properties"])
    _cleaned(top)
    for name in {*STAGES, *method_sections()} - {*_names(STAGES, plugins), *_names(METHODS, plugins)}:
        del top[name]
    for section, (field, _) in not_set_in_sections().items():
        if section in top:
            _section(top[section], definitions)["properties"].pop(field, None)
    for preset in PRESETS:
        _without_defaults(top, preset_values(preset), definitions)
    _name_things(top, definitions, plugins)
    extends = {
        "type": "string",
        "pattern": rf"(^|/)[^/.]+$|{re.escape(SUFFIX)}$",
        "description": "another spec whose values this one builds on: a file, or the name of one that comes with the package",
    }
    return {
        "$schema": DIALECT,
        "title": "wasp spec",
        "description": "What to run: tasks, assistants, impaired operators, seeds, and every size and budget.",
        "type": "object",
        "properties": {EXTENDS: extends, "name": top.pop("name"), "preset": top.pop("preset"), SHORT: _task(plugins), **top},
        "additionalProperties": False,
        "required": ["name"],
        # A base may say what is missing here.
        "if": {"not": {"required": [EXTENDS]}},
        "then": {"required": ["methods", "seeds"], "anyOf": [{"required": [SHORT]}, {"required": ["tasks"]}]},
        "not": {"required": [SHORT, "tasks"]},
        "$defs": _used(definitions, top),
    }


def _name_things(top: Schema, definitions: Schema, plugins: bool) -> None:
    """The names that the registries know, where a spec writes them."""
    methods, operators = _names(METHODS, plugins), _names(OPERATORS, plugins)
    variants = assistant_variants() if plugins else list(dict.fromkeys(name for key in methods for name in METHODS[key].variants))
    top["tasks"]["items"] = _task(plugins)
    for name, known in (
        ("methods", methods),
        ("stages", [kind for kind in training_stages() if kind in _names(STAGES, plugins)]),
        ("variants", variants),
    ):
        top[name]["items"] = {"enum": known}
    top["methods"]["items"]["enumDescriptions"] = [METHODS[name].rule for name in methods]  # editors show them
    for name in ("tasks", "methods", "stages", "variants", "seeds"):
        top[name]["uniqueItems"] = True
    top["operators"]["propertyNames"] = {"enum": operators}
    top["operators"]["additionalProperties"]["additionalProperties"] = False  # names of severities have a pattern
    own = {name: top[name] for name in (*STAGES, *method_sections()) if name in top and name not in EVERYWHERE}
    top["by_task"]["propertyNames"] = _task(plugins)
    top["by_task"]["additionalProperties"] = {"type": "object", "properties": own, "additionalProperties": False}
    for section in [kind for kind in mixing_stages() if kind in top]:
        _section(top[section], definitions)["properties"]["operators"]["propertyNames"] = {"enum": operators}


def _task(plugins: bool) -> Schema:
    """A registered task, or any gymnasium id."""
    known = {"enum": _names(TASKS, plugins)}
    foreign = {"type": "string", "pattern": FOREIGN, "examples": ["my_pkg:MyEnv-v0"]}
    return {"description": "a task (`wasp list tasks`), or a gymnasium id", "anyOf": [known, foreign]}


def _names(registry: Registry[Any], plugins: bool) -> list[str]:
    return list(registry if plugins else registry.own)


def _section(reference: Schema, definitions: Schema) -> Schema:
    """The definition that a section refers to."""
    definition: Schema = definitions[reference["$ref"].rpartition("/")[2]]
    return definition


def _cleaned(properties: Schema) -> None:
    for field in properties.values():
        for mark in MARKS:
            field.pop(mark, None)
        if field.get("type") == "array" and "minLength" in field:  # pydantic's word for a length behind a validator
            field["minItems"] = field.pop("minLength")


def _without_defaults(properties: Schema, preset: Mapping[str, Any], definitions: Schema) -> None:
    """What presets change has no one default; nor has a section, whose fields say theirs."""
    for name, value in preset.items():
        if name not in properties:
            continue
        properties[name].pop("default", None)
        if isinstance(value, Mapping) and "$ref" in properties[name]:
            _without_defaults(_section(properties[name], definitions)["properties"], value, definitions)


def _used(definitions: Schema, *within: Any) -> Schema:
    """The definitions that something refers to, also through others."""
    used = reached(_references(list(within)), lambda name: _references(definitions[name]))
    return {name: definitions[name] for name in sorted(used)}


def _references(node: Any) -> Iterable[str]:
    if isinstance(node, Mapping):
        if "$ref" in node:
            yield node["$ref"].rpartition("/")[2]
        for value in node.values():
            yield from _references(value)
    elif isinstance(node, list):
        for value in node:
            yield from _references(value)
