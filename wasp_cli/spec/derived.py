"""Specs that are made from another one: the ablation of a method, the planner's benchmark, the check of the operators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, cast

from wasp_cli.errors import UnknownName, UsageError
from wasp_cli.learning.configs import CriticsConfig, PoliciesConfig, ReturnsConfig, WorldModelConfig
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.registry import METHODS
from wasp_cli.spec.load import Loaded, load
from wasp_cli.spec.model import Spec, preset_names, validate
from wasp_cli.spec.names import LONGEST, assistant_variants
from wasp_cli.tasks.registry import TASKS

WHOLE = "full"


def ablation(path: Path, variant: str, task: str | None = None, preset: str | None = None, settings: Sequence[str] = ()) -> Loaded:
    """The spec at `path` with the method that has `variant`, run whole and as that variant.

    Raises:
        UnknownName: no such variant, task or preset.
        InvalidSpec: the spec at `path` is not valid.
    """
    if variant not in assistant_variants():
        raise UnknownName("assistant variant", variant, assistant_variants())
    # The whole method is in every ablation; for `full` itself, it is the method that can be ablated.
    method = next(info.name for info in METHODS.values() if variant in info.variants and len(info.variants) > 1)
    narrowed = [f"name=ablate-{variant}", f"methods=[{method}]", f"variants=[{', '.join(dict.fromkeys((WHOLE, variant)))}]"]
    if task is not None:
        narrowed.append(f"tasks=[{TASKS[task].name}]")
    if preset is not None:
        if preset not in preset_names():
            raise UnknownName("preset", preset, preset_names())
        narrowed.append(f"preset={preset}")
    return load(path, [*narrowed, *settings])


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


def operators_alone(path: Path, settings: Sequence[str] = ()) -> Loaded:
    """The spec at `path` with the methods Human-only and Expert; its cells are those of the whole spec, with the same keys.

    Raises:
        InvalidSpec: the spec at `path` is not valid, or lists no operators.
        UsageError: a setting is not of the form `a.b=value`.
    """
    whole = load(path, settings)
    if not whole.spec.operators:
        hint = "for example operators: {laggy: {mild: 0.5, moderate: 0.7, severe: 0.85}}"
        raise whole.problem(("operators",), "no operators are listed, so that there is none to measure", hint)
    name = f"operators-{whole.spec.name}"[:LONGEST]
    # Behind the settings, which must not bring back what is left out here.
    return load(path, [*settings, f"name={name}", "methods=[human, expert]", "variants=[full]", "stages=[]"])
