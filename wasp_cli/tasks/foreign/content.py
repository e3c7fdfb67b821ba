"""The content of an observation: two have the same bytes where they are equal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def content_of(seen: Any) -> bytes:
    """Return an observation, or anything in it, as bytes."""
    if isinstance(seen, Mapping):
        content = b""
        for name in sorted(seen, key=str):
            content += str(name).encode() + content_of(seen[name])
        return content
    if isinstance(seen, tuple | list):
        return b"".join(map(content_of, seen))
    return np.asarray(seen).tobytes()
