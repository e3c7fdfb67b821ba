"""A small spec without a mistake, and many that have one."""

import json
from pathlib import Path
from typing import Any

GOOD = """\
name: good
preset: smoke
tasks: [goal1]
methods: [human, wasp]
operators:
  noisy: {mild: 0.2}
seeds: [0]
"""


def mistakes(table: str) -> list[tuple[Any, ...]]:
    """The rows of tests/golden/spec_mistakes.json for one test: what is written, where it is
    refused, what is said.
    """
    rows = json.loads(
        (Path(__file__).parents[1] / "golden" / "spec_mistakes.json").read_text(encoding="utf-8")
    )[table]
    return [
        tuple(tuple(value) if isinstance(value, list) else value for value in row) for row in rows
    ]
