"""JSON without NaN and infinity, which it cannot hold: null in their place."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any


def finite_json(value: Any) -> str:
    """Return a value of mappings, lists and plain values as JSON text, with null for NaN and
    infinite numbers.
    """
    return json.dumps(_finite(value), indent=1, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
