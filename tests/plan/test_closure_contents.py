"""What the key of each sort of node may cover: a training module in an evaluation, or a picture in a stage, fails here."""

import ast
from collections.abc import Iterator
from fnmatch import fnmatchcase
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

EVERY = "config seeds learning learning.configs stages stages.base tasks tasks.*"
"""The worlds are roots of every node, so that all of `tasks` is allowed but what checks and shows them (see NEVER)."""
NEVER = ("tasks.describe", "tasks.sheet", "tasks.driver", "tasks.camera.topdown", "tasks.camera.view3d")
WEIGHTS = "models models.nets models.weights"
POLICY = f"{WEIGHTS} models.policy"
WORLD = f"{WEIGHTS} models.base models.rssm models.unroll models.world_model"
OPERATOR = "operators operators.base"
OPERATORS_BY_NAME = f"{OPERATOR} operators.*"
ASSISTANT = f"{POLICY} {WORLD} {OPERATOR} methods methods.base"
LATENTS = "learning.latents learning.shards learning.sampling"
DRIVING = f"{ASSISTANT} learning.closed_loop"
METHOD = f"{ASSISTANT} learning.assistants methods.* metrics metrics.episode models.*"
WASP = f"{ASSISTANT} learning.assistants methods.configs methods.noise methods.record methods.wasp methods.wasp.* metrics metrics.episode"
CRITICS = "models.critics methods.wasp methods.wasp.returns"
IMAGINATION = "models.coded models.packed"
PPO = "learning.lagrangian learning.vec_env"
BRANCHES = "store store.branches store.parquet store.recorded store.tables metrics metrics.episode metrics.necessity metrics.windows"

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

MAY_HAVE = {
    "expert": f"{POLICY} {PPO} learning.expert learning.privileged stages.finite",
    "dataset": f"{POLICY} learning.dataset learning.contents learning.shards",
    "world_model": f"{WORLD} {LATENTS} learning.encoding learning.checkpoint learning.device learning.windows learning.world_model "
    "learning.privileged_state",
    "latents": f"{WORLD} learning.latents learning.shards learning.encoding learning.device",
    "diagnostics": (
        f"{POLICY} {WORLD} {LATENTS} learning.encoding learning.dataset learning.diagnostics learning.image_samples learning.readout "
        "metrics metrics.ranking metrics.reliability stages.finite"
    ),
    "policies": (
        f"{DRIVING} {LATENTS} {PPO} methods.human learning.dataset learning.latent_ppo learning.policies "
        "learning.privileged learning.reinforce learning.verdicts stages.finite"
    ),
    "critics": (
        f"{ASSISTANT} {LATENTS} {CRITICS} learning.critics learning.critic_quality learning.heldout learning.recorded_values "
        "metrics metrics.ranking"
    ),
    "heldout": f"{DRIVING} methods.human learning.heldout learning.informed learning.nominal",
    "ida_q": f"{ASSISTANT} {LATENTS} models.ensemble learning.critic_quality learning.ensemble learning.heldout metrics metrics.ranking",
    "denoiser": (
        f"{POLICY} {WORLD} {LATENTS} {OPERATOR} models.denoiser learning.denoiser learning.labelled "
        "methods methods.base methods.configs methods.diffusion methods.noise methods.record metrics metrics.episode"
    ),
    "consistency": f"{POLICY} {LATENTS} models.base models.consistency learning.consistency learning.labelled",
    "reachability": (
        f"{ASSISTANT} {LATENTS} models.reachability learning.reachability learning.heldout metrics metrics.ranking metrics.windows"
    ),
    "residual": (
        f"{ASSISTANT} {PPO} {OPERATORS_BY_NAME} models.residual learning.closed_loop learning.latent_ppo learning.residual stages.finite "
        "learning.informed"
    ),
    "clone": f"{OPERATOR} {WEIGHTS} models.base models.clone operators.* learning.clone learning.sampling",
    "calibration": f"{ASSISTANT} {METHOD} metrics.windows learning.heldout",
    "evaluate": (
        f"{DRIVING} {METHOD} {OPERATORS_BY_NAME} learning.device learning.evaluation learning.informed store store.parquet store.tables"
    ),
    "counterfactual": (
        f"{ASSISTANT} {OPERATORS_BY_NAME} {BRANCHES} learning.closed_loop learning.counterfactual learning.heldout learning.informed "
        "learning.playback learning.rerun models.clone"
    ),
}
"""By node kind, names and patterns without the package's own name; its stage and what EVERY node has come on top."""


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


SHIPPED = "world_model policies critics ida_q denoiser consistency reachability residual"
"""Whose weights are rounded as they ship."""


def patterns(kind: str) -> list[str]:
    (file,) = (file for file, kinds in SECTIONS.items() if kind in kinds.split())
    rounding = "learning.rounding" if kind in SHIPPED.split() else ""
    return f"{EVERY} {rounding} learning.configs.shared learning.configs.{file} stages.{kind} {MAY_HAVE[kind]}".split()


def short(modules: frozenset[str]) -> set[str]:
    return {module.removeprefix("wasp_cli.") for module in modules}


def test_every_stage_has_a_node_here_and_says_what_it_may_have():
    assert set(closures()) == set(STAGES) == set(MAY_HAVE)


@pytest.mark.parametrize("kind", sorted(MAY_HAVE))
def test_a_node_s_key_covers_what_it_runs_and_no_more(kind):
    reached = short(closures()[kind])
    allowed = {module for module in reached if any(fnmatchcase(module, pattern) for pattern in patterns(kind))}
    assert reached - allowed == set()
    assert {module for module in reached if any(fnmatchcase(module, pattern) for pattern in NEVER)} == set()


@pytest.mark.parametrize("kind", sorted(MAY_HAVE))
def test_nothing_is_allowed_that_no_node_has(kind):
    reached = short(closures()[kind])
    assert [pattern for pattern in MAY_HAVE[kind].split() if not any(fnmatchcase(module, pattern) for module in reached)] == []


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
