"""Every value in force that the paper does not state, or states otherwise."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

from wasp_cli.config import assumptions
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.grid import ASSISTANT, ROLLOUTS, stage_class
from wasp_cli.spec.model import Spec
from wasp_cli.stages.registry import STAGES

Assumption = tuple[str, Any, str]
"""Dotted name, value, why."""


def assumptions_in_force(spec: Spec) -> Iterator[Assumption]:
    """The assumptions of the stages and methods that this spec uses."""
    kinds: set[str] = set()

    def need(kind: str) -> None:
        if kind not in kinds:
            kinds.add(kind)
            for upstream in stage_class(kind).needs:
                need(upstream)

    for method in spec.methods:
        info, config = METHODS[method], spec.method(method).model_dump(mode="json")
        for kind in ("evaluate", *info.needs_of(config), *(["calibration"] if info.calibrated else [])):
            need(kind)
    for kind in spec.stages:
        need(kind)
    if spec.rounds > 1:
        need(ROLLOUTS)
    assistants = {*spec.methods, *([ASSISTANT] if spec.rounds > 1 else [])}
    for name, value, why in assumptions(spec):
        section = name.partition(".")[0] if "." in name else ""
        idle = section not in kinds if section in STAGES else section in METHODS and section not in assistants
        if not idle:
            yield name, value, why


def assumptions_markdown(found: Sequence[Assumption]) -> str:
    """A Markdown section: every value in force that is not the paper's."""
    lines = [
        "## Assumptions in force",
        "",
        "Values that the paper leaves open or that differ from it. A spec can change each.",
        "",
    ]
    lines += ["| Field | Value | Why |", "| --- | --- | --- |"]
    for name, value, why in found:
        shown = json.dumps(value, default=str, ensure_ascii=False)
        lines.append("| " + " | ".join(text.replace("|", "\\|") for text in (f"`{name}`", f"`{shown}`", why)) + " |")
    return "\n".join(lines) + "\n"
