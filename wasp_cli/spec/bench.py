"""The configurations that `wasp bench planner` measures: the models of a spec under two planners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, cast

from wasp_cli.errors import UsageError
from wasp_cli.learning.configs import CriticsConfig, PoliciesConfig, ReturnsConfig, WorldModelConfig
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.spec.load import load
from wasp_cli.spec.model import Spec, validate

PAPER: Mapping[str, int] = {"probe": 300, "candidates": 300, "elites": 100, "iterations": 6, "feasible": 100, "rollouts": 1}
"""N_probe, N, N_e and I of section 5.1; N_f = N_e and M = 1, which it leaves open."""


class PlannerConfigs(NamedTuple):
    """What a decision of WASP is measured with."""

    world_model: WorldModelConfig
    policies: PoliciesConfig
    critics: CriticsConfig
    wasp: WASPConfig
    returns: ReturnsConfig


def bench_configs(path: Path | None, settings: Sequence[str] = ()) -> dict[str, PlannerConfigs]:
    """By planner: the sections of the models, of WASP, and of the returns. Without a spec, those of the preset `cpu`.

    Raises:
        InvalidSpec: the spec is not valid.
        UsageError: settings without a spec.
    """
    if path is None and settings:
        raise UsageError("--set changes a spec, and none is given", "wasp bench planner SPEC --set KEY=VALUE")
    spec = _smallest() if path is None else load(path, settings).spec
    own = cast(WASPConfig, spec.method("wasp"))
    paper = WASPConfig.model_validate({**own.model_dump(), **PAPER})
    models = (
        cast(WorldModelConfig, spec.stage("world_model")),
        cast(PoliciesConfig, spec.stage("policies")),
        cast(CriticsConfig, spec.stage("critics")),
    )
    return {"paper": PlannerConfigs(*models, paper, spec.returns), spec.preset: PlannerConfigs(*models, own, spec.returns)}


def _smallest() -> Spec:
    """A spec of defaults."""
    operators = {"laggy": {"moderate": 0.7}}
    return validate({"name": "bench", "tasks": ["goal1"], "methods": ["wasp"], "operators": operators, "seeds": [0]})
