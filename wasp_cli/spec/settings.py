"""The settings that a spec has, by their dotted names: for suggestions, for completion, and for what presets change."""

from __future__ import annotations

from functools import cache

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from wasp_cli.spec.model import spec_type
from wasp_cli.spec.where import Loc


def model_at(loc: Loc) -> type[BaseModel] | None:
    """The model of a section; that of the whole spec for an empty place."""
    model: type[BaseModel] = spec_type()
    for part in loc:
        below = _section(model.model_fields.get(str(part)))
        if below is None:
            return None
        model = below
    return model


def description(loc: Loc) -> str | None:
    """What the models say of a setting."""
    model = model_at(loc[:-1])
    field = model.model_fields.get(str(loc[-1])) if model is not None and loc else None
    return field.description if field is not None else None


@cache
def settings() -> tuple[str, ...]:
    """Every setting as `--set` names it, sections before what is in them: `wasp`, `wasp.candidates`."""
    return tuple(_below(spec_type(), ""))


def _below(model: type[BaseModel], prefix: str) -> list[str]:
    found: list[str] = []
    for name, field in model.model_fields.items():
        found.append(prefix + name)
        if (section := _section(field)) is not None:
            found += _below(section, f"{prefix}{name}.")
    return found


def _section(field: FieldInfo | None) -> type[BaseModel] | None:
    if field is None or not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
        return None
    return field.annotation
