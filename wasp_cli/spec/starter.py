"""A spec to start with, for an environment that was tried."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

BODY = """\
methods: [human, wasp, expert]
operators:
  noisy: {moderate: auto}             # auto: chosen on held-out worlds
  reaction-time: {moderate: auto}
seeds: [0]
episodes: 10
"""


def starter(
    entry: Mapping[str, Any],
    preset: str,
    remarks: Mapping[str, str],
    interactions: int | None = None,
) -> str:
    """Return the text of a spec for an environment.

    Args:
        entry: the environment, as an entry of `tasks`.
        preset: the sizes.
        remarks: by key of the entry, a comment after its line.
        interactions: decisions in which the expert trains; None leaves those of the preset.
    """
    named = str(entry.get("name", entry["id"])).rpartition(":")[2]
    name = re.sub(r"[^a-z0-9]+", "-", re.sub(r"-v\d+$", "", named).lower()).strip("-") or "tried"
    lines = [f"name: {name}", f"preset: {preset}", "tasks:"]
    for number, (key, value) in enumerate(entry.items()):
        line = f"  {'-' if number == 0 else ' '} {key}: {_yaml(value)}"
        if key in remarks:
            line += f"      # {remarks[key]}"
        lines.append(line)
    if interactions is not None:
        lines.append(f"expert: {{interactions: {interactions}}}      # about half an hour here")
    return "\n".join(lines) + "\n" + BODY


def _yaml(value: object) -> str:
    """A value in the flow style of YAML: JSON, except for texts that need no quotes."""
    if isinstance(value, str) and re.fullmatch(r"[A-Za-z][\w./:-]*[\w]", value):
        plain = value.lower() not in ("true", "false", "null", "yes", "no", "on", "off")
        return value if plain else json.dumps(value)
    return json.dumps(value)
