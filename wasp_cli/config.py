"""The base of every configuration model, and the marks of values that the paper leaves open or that differ from it."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

DIFFERS = "differs from the paper"
"""How a reason begins whose value is not what the paper says."""


class Config(BaseModel):
    """A frozen configuration: unknown keys are errors, values never change after validation."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    def identity(self) -> dict[str, Any]:
        """Return the values as JSON values, without those that can move no result, and without optional ones at their defaults."""
        values = self.model_dump(mode="json")
        for name, info in type(self).model_fields.items():
            value, extra = getattr(self, name), info.json_schema_extra
            of_key = extra.get("in_key", True) if isinstance(extra, dict) else True
            if of_key is False or (of_key == OPTIONAL and value == info.default):
                del values[name]
            elif isinstance(value, Config):
                values[name] = value.identity()
        return values


OPTIONAL = "unless default"
"""Of a field that came later: at its default, which does what was done without it, results keep the keys from before."""


def assumed(default: Any, why: str, *, in_key: bool | str = True, **constraints: Any) -> Any:
    """Declare a field whose value is not in the paper. `why` says where the value comes from; reports list it.

    One that can move no result (`in_key` false) enters no key: changing it runs nothing again. `OPTIONAL` enters none at its default.
    """
    return Field(default=default, description=why, json_schema_extra={"in_paper": False, "in_key": in_key}, **constraints)


def from_paper(default: Any, where: str, **constraints: Any) -> Any:
    """Declare a field whose value the paper states. `where` names the place."""
    return Field(default=default, description=where, json_schema_extra={"in_paper": True}, **constraints)


def deviates(default: Any, why: str, **constraints: Any) -> Any:
    """Declare a field whose default is not what the paper says.

    `why` says what the paper has and why not; reports list it first.
    """
    return Field(default=default, description=why, json_schema_extra={"in_paper": "differs"}, **constraints)


def assumptions(model: Config, prefix: str = "") -> list[tuple[str, Any, str]]:
    """List every value that is not the paper's as (dotted name, value in force, why), in field order."""
    found: list[tuple[str, Any, str]] = []
    for name, info in type(model).model_fields.items():
        value = getattr(model, name)
        extra = info.json_schema_extra
        if isinstance(value, Config):
            found += assumptions(value, f"{prefix}{name}.")
        elif isinstance(extra, dict) and extra.get("in_paper") in (False, "differs"):
            mark = f"{DIFFERS}: " if extra["in_paper"] == "differs" else ""
            found.append((f"{prefix}{name}", value, mark + (info.description or "")))
        elif isinstance(extra, dict) and extra.get("in_paper") is True and value != info.default:
            # The default is what the paper states.
            found.append((f"{prefix}{name}", value, f"{DIFFERS}, which has {info.default}: {info.description}"))
    return found
