"""How a mistake in a spec is put right: keys that are called nearly so, and values written with the right type."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from wasp_cli.errors import did_you_mean
from wasp_cli.spec.model import spec_type
from wasp_cli.spec.names import EXTENDS, TOP
from wasp_cli.spec.settings import model_at, settings
from wasp_cli.spec.where import Loc

CLOSE = "did you mean"
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_BOOLEANS = {"true": "true", "yes": "true", "on": "true", "false": "false", "no": "false", "off": "false"}


def key_hint(loc: Loc) -> str:
    """Close keys of the same section, or the section that has the key, or one that has a close key."""
    if loc == (EXTENDS,):  # in a file it is taken out before
        return "a file says itself what it extends"
    name, section = str(loc[-1]), ".".join(map(str, loc[:-1]))
    if section and name in (*spec_type().model_fields, *TOP):
        return f"'{name}' stands at the top, outside every section"
    model = model_at(loc[:-1])
    known = [*(model.model_fields if model is not None else ()), *(TOP if not section else ())]
    hint = did_you_mean(name, known)
    return hint if hint.startswith(CLOSE) else _elsewhere(name, section) or hint


def _elsewhere(name: str, section: str) -> str | None:
    """Settings of other sections with this name, or nearly: first those within the section."""
    near = sorted((path for path in settings() if "." in path), key=lambda path: not path.startswith(f"{section}."))
    paths = [f"'{path}'" for path in near if path.rpartition(".")[2] == name][:3]
    if paths:
        return f"{CLOSE} " + " or ".join(filter(None, (", ".join(paths[:-1]), paths[-1]))) + "?"
    leaves = {path.rpartition(".")[2]: path for path in reversed(near)}
    hint = did_you_mean(name, leaves)
    return re.sub(r"'([^']*)'", lambda leaf: f"'{leaves[leaf[1]]}'", hint) if hint.startswith(CLOSE) else None


def value_hint(value: Any, types: Sequence[str]) -> str | None:
    """How a value is written so that it has the right type, where one can tell.

    Args:
        value: the wrong one.
        types: pydantic's names of what is wrong with it.
    """
    if "tuple_type" in types and isinstance(value, str | int | float):
        return f"write [{_written(value)}]"
    if "dict_type" in types and isinstance(value, int | float) and not isinstance(value, bool):
        return f"with a name, for example {{moderate: {value}}}"
    if "bool_type" in types and str(value).lower() in _BOOLEANS:
        return f"write {_BOOLEANS[str(value).lower()]}"
    if "string_type" in types and isinstance(value, int | float):
        return f'in quotes: "{_written(value)}"'
    numeric = "float_type" in types or ("int_type" in types and not re.search(r"[.eE]", str(value)))
    if isinstance(value, str) and numeric and _NUMBER.fullmatch(value):
        return f"without quotes: {value}"
    return None


def _written(value: Any) -> str:
    """A scalar as YAML has it."""
    return str(value).lower() if isinstance(value, bool) else str(value)
