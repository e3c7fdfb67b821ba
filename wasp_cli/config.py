"""The base of every configuration model, and the marks of values that the paper leaves open or
that differ from it.
"""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field

DIFFERS = "differs from the paper"
"""How a reason begins whose value is not what the paper says."""


class Config(BaseModel):
    """A frozen configuration: unknown keys are errors, values never change after validation."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    edition: ClassVar[int] = 1
    """Raised when a default changes: values at their defaults enter no key, so that a new field
    orphans no result.
    """

    def identity(self) -> dict[str, Any]:
        """Return the values that enter a key, as JSON values: those that can move a result and
        are not at their defaults.
        """
        dumped = self.model_dump(mode="json")
        values: dict[str, Any] = {} if self.edition == 1 else {"edition": self.edition}
        for name, info in type(self).model_fields.items():
            value, default, extra = (
                getattr(self, name),
                info.get_default(call_default_factory=True),
                info.json_schema_extra,
            )
            if isinstance(extra, dict) and extra.get("in_key") is False:
                continue
            if isinstance(value, Config):
                # By the defaults of its class, or a section at its defaults in one model would have
                # another identity in another model.
                inner = value.identity()
                if inner or not isinstance(default, Config):
                    values[name] = inner
            elif value != default:
                values[name] = dumped[name]
        return values


def assumed(default: Any, why: str, *, in_key: bool = True, **constraints: Any) -> Any:
    """Declare a field whose value is not in the paper. `why` says where the value comes from;
    reports list it.

    One that can move no result (`in_key` false) enters no key: changing it runs nothing again.
    """
    return Field(
        default=default,
        description=why,
        json_schema_extra={"in_paper": False, "in_key": in_key},
        **constraints,
    )


def from_paper(default: Any, where: str, **constraints: Any) -> Any:
    """Declare a field whose value the paper states. `where` names the place."""
    return Field(
        default=default, description=where, json_schema_extra={"in_paper": True}, **constraints
    )


def deviates(default: Any, why: str, **constraints: Any) -> Any:
    """Declare a field whose default is not what the paper says.

    `why` says what the paper has and why not; reports list it first.
    """
    return Field(
        default=default, description=why, json_schema_extra={"in_paper": "differs"}, **constraints
    )


def assumptions(model: Config, prefix: str = "") -> list[tuple[str, Any, str]]:
    """List every value that is not the paper's as (dotted name, value in force, why), in field
    order.
    """
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
            found.append(
                (
                    f"{prefix}{name}",
                    value,
                    f"{DIFFERS}, which has {info.default}: {info.description}",
                )
            )
    return found
