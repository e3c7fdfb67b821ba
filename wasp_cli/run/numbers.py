"""The line of numbers that a finished node has in the journal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.store.plain import printable

SHOWN = 6  # numbers of a summary that fit on a line
OPERATING_POINT = "operating_point"  # the summary of the stage `operating` has it, in words


def numbers_line(summary: Mapping[str, Any]) -> str:
    """Return the first SHOWN numbers of a node's summary, after its operating point if it chose
    one.
    """
    values = [(name, value) for name, value in summary.items() if isinstance(value, int | float)]
    texts = [
        f"{name} {value}" if isinstance(value, int) else f"{name} {value:.4g}"
        for name, value in values[:SHOWN]
    ]
    point = summary.get(OPERATING_POINT)
    if isinstance(point, str):
        texts.insert(0, printable(point))
    return ", ".join(texts)
