"""Limited-skill operator: the policy of an earlier expert checkpoint."""

from __future__ import annotations

from typing import Self

from wasp_cli.operators.base import NoiseSource, Operator, OperatorContext


class LimitedSkillOperator(Operator):
    """See the module; the severity is the fraction of the expert's interactions."""

    @classmethod
    def build(cls, value: float, context: OperatorContext, noise: NoiseSource, batch: int) -> Self:
        """Build an operator with the skill at the fraction `value` of the interactions."""
        return cls.skilled(value, context, noise, batch)
