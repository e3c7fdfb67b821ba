"""From a variant's name and severity to an operator."""

from __future__ import annotations

from wasp_cli.operators.base import Operator, OperatorContext
from wasp_cli.operators.noise import NoiseSource
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED


def build_operator(variant: str, value: float | None, context: OperatorContext, noise: NoiseSource, batch: int) -> Operator:
    """An operator of `batch` rows; the variant "none" is the unimpaired expert.

    Raises:
        UnknownName: no such variant.
    """
    if variant == UNIMPAIRED or value is None:
        return Operator.build(1.0, context, noise, batch)
    operator: Operator = OPERATORS.load(variant).build(value, context, noise, batch)
    return operator
