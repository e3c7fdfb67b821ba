"""How long an expert may train in an environment whose steps are slow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.plan.grid import stage_class
from wasp_cli.plan.tried import Tried
from wasp_cli.plan.unmeasured import REPEAT
from wasp_cli.spec.presets import preset_values

EXPERT_SECONDS = 30 * 60.0
"""Wall time that the env steps of an expert's training may take."""
LEAST = 60_000
"""Decisions that every expert gets, however slow its environment is."""
ROUNDED_TO = 10_000


def affordable_interactions(
    preset: str, found: Tried, entry: Mapping[str, Any], cores: int
) -> int | None:
    """Return the decisions for which an expert can train in `EXPERT_SECONDS`; None if those of the
    preset take no longer.

    Args:
        preset: name of the preset.
        found: times of the environment on this machine.
        entry: the environment, as an entry of `tasks`.
        cores: processes that step the environments.
    """
    section = preset_values(preset).get("expert", {})
    usual = int(stage_class("expert").config.model_validate(section).model_dump()["interactions"])
    decision_seconds = found.bare_seconds * int(entry.get("action_repeat", REPEAT))
    affordable = int(EXPERT_SECONDS * cores / decision_seconds)
    if affordable >= usual:
        return None
    return max(affordable - affordable % ROUNDED_TO, LEAST)
