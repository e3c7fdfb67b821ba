"""The pilots of Yoneda et al. 2023: the expert, who sees the goal, noisy or late, and one who
does nothing.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from tests.external.lander import Kind
from wasp_cli.operators.base import EpisodeNoise, Memory, Operator, OperatorContext
from wasp_cli.operators.laggy import LaggyOperator
from wasp_cli.operators.noisy import NoisyOperator


class ZeroOperator(Operator):
    """Commands nothing."""

    def act(self, intended: Tensor, memory: Memory, uniforms: Tensor) -> tuple[Tensor, Memory]:
        return torch.zeros_like(intended), memory


PILOTS: dict[Kind, dict[str, tuple[type[Operator], float]]] = {
    kind: {
        "expert": (Operator, 1.0),
        "noisy": (NoisyOperator, noise),
        "laggy": (LaggyOperator, 0.85),
        "zero": (ZeroOperator, 0.0),
    }
    for kind, noise in (("lander", 0.3), ("reacher", 0.6))
}
"""Class and severity of each."""
PILOTS["lander"]["laggier"] = (LaggyOperator, 0.9)
"""Lag harms our expert less than theirs: this pilot is as bad alone as their laggy one."""


def build(
    kind: Kind,
    pilot: str,
    expert: Callable[[Tensor], Tensor],
    seeds: Sequence[int],
    value: float | None = None,
) -> Operator:
    """Build a pilot of one row per seed; `value` is another severity than the authors'."""
    operator, severity = PILOTS[kind][pilot]

    def unknown(features: Tensor) -> Tensor:
        raise AssertionError("nobody flies by what everybody sees: the goal is not in it")

    context = OperatorContext(
        lambda fraction: unknown,
        action_size=2,
        decision_seconds=0.02,
        informed=lambda fraction: expert,
    )
    return operator.build(
        severity if value is None else value, context, EpisodeNoise(seeds), len(seeds)
    )
