"""The JSON Schema of a spec, for editors: they complete keys and names, show what they mean, and
mark what is wrong.

It has the names of the plugins that are installed. A schema cannot express all that the models
check, such as limits of severities and what depends on several keys: `wasp check` checks these.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.spec.environments import FIELD
from wasp_cli.spec.hints import not_set_in_sections
from wasp_cli.spec.load import SUFFIX
from wasp_cli.spec.model import EVERYWHERE, method_sections, mixing_stages, spec_type
from wasp_cli.spec.names import EXTENDS, SHORT, assistant_variants, training_stages
from wasp_cli.spec.presets import PRESETS, preset_values
from wasp_cli.stages.registry import STAGES
from wasp_cli.tasks.declared import NAME, Declaration
from wasp_cli.tasks.registry import TASKS

DIALECT = "https://json-schema.org/draft/2020-12/schema"
MARKS = ("in_key", "in_paper")  # of the models, for keys and reports; not part of JSON Schema
FOREIGN = (
    r"^(?!(wasp_cli\.tasks\.gym:)?wasp/)(?=.*[:/]|.*-v[0-9]+$)"
    r"([A-Za-z_][A-Za-z0-9_.]*:)?[A-Za-z0-9_./-]{1,100}$"
)
"""`tasks.registry.is_foreign` as a pattern."""
OWN = r"^[A-Za-z_][A-Za-z0-9_.]*:[A-Za-z_][A-Za-z0-9_]*$"
"""A class of one's own: `methods.registry.OwnMethod`."""
Schema = dict[str, Any]


class _Untitled(GenerateJsonSchema):
    """Without a title for each field, which would repeat its name."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def spec_schema() -> Schema:
    """Return the JSON Schema (draft 2020-12) of a spec, with the names that are registered here."""
    schema = spec_type().model_json_schema(schema_generator=_Untitled)
    definitions = schema["$defs"]
    top = schema["properties"]
    for model in definitions.values():
        _cleaned(model.get("properties", {}))
        # A description is a docstring, whose lines are those of the source.
        if "description" in model:
            model["description"] = " ".join(model["description"].split())
    _cleaned(top)
    for section, (field, _) in not_set_in_sections().items():
        _section(top[section], definitions)["properties"].pop(field, None)
    for preset in PRESETS:
        _without_defaults(top, preset_values(preset), definitions)
    _name_things(top, definitions)
    extends = {
        "type": "string",
        "pattern": rf"(^|/)[^/.]+$|{re.escape(SUFFIX)}$",
        "description": "another spec whose values this one builds on: a file, or the name of one "
        "that comes with the package",
    }
    return {
        "$schema": DIALECT,
        "title": "wasp spec",
        "description": "What to run: tasks, assistants, impaired operators, seeds, and every size "
        "and budget.",
        "type": "object",
        "properties": {
            EXTENDS: extends,
            "name": top.pop("name"),
            "preset": top.pop("preset"),
            SHORT: _entry(),
            **top,
        },
        "additionalProperties": False,
        "required": ["name"],
        # A base may say what is missing here.
        "if": {"not": {"required": [EXTENDS]}},
        "then": {
            "required": ["methods", "seeds"],
            "anyOf": [{"required": [SHORT]}, {"required": ["tasks"]}],
        },
        "not": {"required": [SHORT, "tasks"]},
        "$defs": dict(sorted(definitions.items())),
    }


def _name_things(top: Schema, definitions: Schema) -> None:
    top.pop(FIELD)  # files write it in `tasks`
    for name in ("methods", "stages", "variants", "tasks", "seeds"):
        top[name]["uniqueItems"] = True
    for name, known in (("stages", training_stages()), ("variants", assistant_variants())):
        top[name]["items"] = {"enum": known}
    top["tasks"]["items"] = _entry()
    # editors show them
    named = {"enum": list(METHODS), "enumDescriptions": [info.rule for info in METHODS.values()]}
    top["methods"]["items"] = {
        "anyOf": [named, {"type": "string", "pattern": OWN, "examples": ["my_module:MyAssistant"]}]
    }
    top["operators"]["propertyNames"] = {"enum": list(OPERATORS)}
    severities = top["operators"]["additionalProperties"]
    severities["additionalProperties"] = False  # names of severities have a pattern
    severities["type"] = ["object", "null"]  # null removes an operator of an extended spec
    sections = {name: top[name] for name in (*STAGES, *method_sections()) if name not in EVERYWHERE}
    # The name of a declared environment may be any.
    own_name = {"type": "string", "pattern": NAME}
    top["by_task"]["propertyNames"] = {"anyOf": [_task(), own_name]}
    top["by_task"]["additionalProperties"] = {
        "type": "object",
        "properties": sections,
        "additionalProperties": False,
    }
    for kind in mixing_stages():
        _section(top[kind], definitions)["properties"]["operators"]["propertyNames"] = {
            "enum": list(OPERATORS)
        }
    for name in (*STAGES, *method_sections()):
        # null removes the section of an extended spec
        _section(top[name], definitions)["type"] = ["object", "null"]


def _task() -> Schema:
    foreign = {"type": "string", "pattern": FOREIGN, "examples": ["my_pkg:MyEnv-v0"]}
    return {
        "description": "a task (`wasp list tasks`), or a gymnasium id",
        "anyOf": [{"enum": list(TASKS)}, foreign],
    }


def _entry() -> Schema:
    """A task, or a mapping that declares an environment."""
    return {"anyOf": [_task(), {"$ref": f"#/$defs/{Declaration.__name__}"}]}


def _section(reference: Schema, definitions: Schema) -> Schema:
    definition: Schema = definitions[reference["$ref"].rpartition("/")[2]]
    return definition


def _cleaned(properties: Schema) -> None:
    for field in properties.values():
        for mark in MARKS:
            field.pop(mark, None)
        # pydantic's word for a length behind a validator
        if field.get("type") == "array" and "minLength" in field:
            field["minItems"] = field.pop("minLength")


def _without_defaults(properties: Schema, preset: Mapping[str, Any], definitions: Schema) -> None:
    for name, value in preset.items():
        if name not in properties:
            continue
        properties[name].pop("default", None)
        if isinstance(value, Mapping) and "$ref" in properties[name]:
            _without_defaults(
                _section(properties[name], definitions)["properties"], value, definitions
            )
