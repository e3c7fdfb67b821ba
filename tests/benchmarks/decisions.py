"""Decisions of WASP, and the floating-point operations of their matrix products.

Untrained weights: the arithmetic does not depend on them. Both gates are opened or shut by their
thresholds, so that each kind of decision is timed as it runs in the closed loop.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import torch
from torch.utils.flop_counter import FlopCounterMode

from wasp_cli.learning.configs.latent import CriticsConfig, PoliciesConfig
from wasp_cli.learning.configs.shared import ReturnsConfig
from wasp_cli.learning.configs.world import WorldModelConfig
from wasp_cli.learning.world_model import build
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.assistant import WASP
from wasp_cli.methods.wasp.imagine import Imagination
from wasp_cli.models.base import Latent
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.policy import Skills
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.spec.model import validate
from wasp_cli.tasks.motors import UNKNOWN

ACTIONS = 2
NEVER = 1e9  # A threshold that nothing exceeds
ROOF_SHAPES = ((300, 256, 768), (300, 512, 512), (1024, 512, 512))
"""[M, K] x [K, N] of the plain products: the planner's own shapes; the fastest is the roof."""
THRESHOLDS = {"quiet": (NEVER, NEVER), "task": (NEVER, -NEVER), "safety": (-NEVER, NEVER)}
"""(tau_c, tau_r) under which each kind of decision comes about."""

PAPER: Mapping[str, int] = {"candidates": 300, "elites": 100, "iterations": 6, "feasible": 100}
"""N, N_e and I of section 5.1; N_f = N_e, which it leaves open."""


class Configs(NamedTuple):
    """What a decision is measured with."""

    world_model: WorldModelConfig
    policies: PoliciesConfig
    critics: CriticsConfig
    wasp: WASPConfig
    returns: ReturnsConfig


def configs(planner: str) -> Configs:
    """Return the configurations of the preset `cpu`; of `paper` with the paper's search."""
    operators = {"laggy": {"moderate": 0.7}}
    spec = validate(
        {
            "name": "bench",
            "tasks": ["goal1"],
            "methods": ["wasp"],
            "operators": operators,
            "seeds": [0],
        }
    )
    wasp = cast(WASPConfig, spec.method("wasp"))
    if planner == "paper":
        wasp = WASPConfig.model_validate({**wasp.model_dump(), **PAPER})
    models = (
        cast(WorldModelConfig, spec.stage("world_model")),
        cast(PoliciesConfig, spec.stage("policies")),
    )
    return Configs(*models, cast(CriticsConfig, spec.stage("critics")), wasp, spec.returns)


class Setup:
    """An assistant of untrained models and a laggy operator."""

    def __init__(
        self,
        world_model: WorldModelConfig,
        policies: PoliciesConfig,
        critics: CriticsConfig,
        wasp: WASPConfig,
        returns: ReturnsConfig,
        batch: int,
    ) -> None:
        torch.manual_seed(0)
        model = build(world_model, ACTIONS).eval().requires_grad_(False)
        values = LatentCritics(
            model.feature_size, critics.hidden, critics.bins, critics.reach
        ).requires_grad_(False)
        skills = Skills([1.0], model.feature_size, policies.hidden, ACTIONS).requires_grad_(False)
        context = OperatorContext(skill=skills.at, action_size=ACTIONS, decision_seconds=0.1)
        self.imagination = Imagination(
            model, values, skills.expert, returns.gamma_r, returns.gamma_c, returns.lam
        )
        self.operator: Operator = build_operator(
            "laggy", 0.7, context, EpisodeNoise(list(range(batch))), batch
        )
        self.latent: Latent = model.initial(batch)
        self.a_h = self.operator.command(self.latent.features)
        self.assistant = WASP(wasp, self.imagination, {}, UNKNOWN)
        self.reference = WASP(wasp, replace(self.imagination, pack=False), {}, UNKNOWN)
        self.batch = batch

    def decision(self, kind: str, *, reference: bool = False) -> Callable[[], Any]:
        """Return a call that makes one decision of a kind, each time the same one.

        `reference`: by the world model's own steps, every one-hot row a product, whose
        floating-point operations are counted.
        """
        assistant = self.reference if reference else self.assistant
        seeds = list(range(self.batch))
        everyone = torch.ones(self.batch, dtype=torch.bool)

        def decide() -> None:
            assistant.reset(everyone, seeds)
            assistant.tau_c, assistant.tau_r = THRESHOLDS[kind]
            assistant.decide(self.latent, self.a_h, self.operator)

        return decide


def products(setup: Setup, kind: str) -> int:
    """Count the floating-point operations of a decision's matrix products, as the world model's
    own steps multiply.
    """
    with FlopCounterMode(display=False) as counter:
        setup.decision(kind, reference=True)()
    total: int = counter.get_total_flops()
    return total


def matrix_rate(shapes: Sequence[tuple[int, int, int]] = ROOF_SHAPES, repeats: int = 20) -> float:
    """Measure the floating-point operations per second of plain matrix products [M, K] x [K,
    N]: the fastest shape.
    """
    best = 0.0
    for m, k, n in shapes:
        a, b, out = torch.randn(m, k), torch.randn(k, n), torch.empty(m, n)

        def multiply(a: torch.Tensor = a, b: torch.Tensor = b, out: torch.Tensor = out) -> None:
            torch.mm(a, b, out=out)

        multiply()
        best = max(best, 2 * m * k * n / min(_seconds(multiply) for _ in range(repeats)))
    return best


def _seconds(work: Callable[[], Any]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun
