"""What the key of each sort of node may cover: a training module in an evaluation, or a picture in a stage, fails here."""

import ast
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.plan.closure import closure
from wasp_cli.plan.grid import lay_out
from wasp_cli.spec.model import validate
from wasp_cli.spec.names import training_stages
from wasp_cli.stages.registry import STAGES
from wasp_cli.tasks.registry import TASKS

NEVER = ("tasks.sheet", "tasks.driver", "tasks.camera.topdown", "tasks.camera.view3d")
"""What only checks and shows worlds."""
STAGES_MAY_HAVE = frozenset({"stages", "stages.base", "stages.finite"})
SECTIONS = {
    "recorded": "expert dataset",
    "world": "world_model latents diagnostics",
    "latent": "policies critics clone",
    "baselines": "ida_q denoiser residual",
    "consistency": "consistency",
    "reachability": "reachability",
    "judged": "heldout calibration evaluate counterfactual",
}
"""By file of `learning.configs`, the kinds whose sections are in it."""


@cache
def closures() -> dict[str, frozenset[str]]:
    """By node kind, every module in the closure of one, over all tasks, methods, their variants, and operators."""
    document = {
        "name": "all", "preset": "smoke", "tasks": list(TASKS), "methods": list(METHODS), "seeds": [0],
        "stages": training_stages(), "operators": {name: {"some": 0.25} for name in OPERATORS},
    }  # fmt: skip
    found: dict[str, frozenset[str]] = {}
    for node in lay_out(validate(document)).nodes:
        found[node.kind] = found.get(node.kind, frozenset()) | closure(node.modules)
    return found


def short(modules: frozenset[str]) -> set[str]:
    return {module.removeprefix("wasp_cli.") for module in modules}


@pytest.mark.parametrize("kind", sorted(STAGES))
def test_a_node_s_key_covers_its_own_stage_and_settings_and_nobody_else_s(kind):
    covered = short(closures()[kind])
    (section,) = (file for file, kinds in SECTIONS.items() if kind in kinds.split())
    assert {module for module in covered if module.startswith("stages")} - STAGES_MAY_HAVE == {f"stages.{kind}"}
    configs = {module for module in covered if module.startswith("learning.configs.")}
    assert configs <= {"learning.configs.shared", f"learning.configs.{section}"}
    assert not covered & set(NEVER)


@pytest.mark.parametrize("kind", ["evaluate", "calibration", "heldout", "counterfactual"])
def test_what_is_evaluated_trains_nothing_and_reads_no_dataset(kind):
    reached = {module for module in short(closures()[kind]) if module.startswith("learning.")}
    known = "configs configs.judged configs.shared assistants closed_loop device evaluation "
    known += "heldout informed nominal counterfactual playback rerun"
    assert reached <= {f"learning.{name}" for name in known.split()}


DRAWS = ("matplotlib", "PIL.ImageDraw", "PIL.ImageFont", "imageio", "rich", "jinja2", "markupsafe", "typer", "click")
ROOMS = ("report", "video", "cli", "compare")


def imported(module: str) -> Iterator[str]:
    """Everything that the source of a module imports anywhere, functions included, whoever's it is."""
    spec = find_spec(module)
    if spec.origin is None or not spec.origin.endswith(".py"):
        return
    for node in ast.walk(ast.parse(Path(spec.origin).read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_nothing_in_a_key_draws_lays_out_or_belongs_to_a_report():
    everything = frozenset().union(*closures().values())
    forbidden = (*DRAWS, *(f"wasp_cli.{room}" for room in ROOMS))
    found = {
        (module, name) for module in everything for name in imported(module) if any(f"{name}.".startswith(f"{part}.") for part in forbidden)
    }
    assert found == set()
    assert not {module for module in everything if module.split(".")[1] in ROOMS}
