"""The operator variants by name. To add one, write a module with its class, and add one entry here
or an entry point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from wasp_cli.registry import Registry

SPREAD = 5  # severities that `auto` tries where an operator does not name them, beside the mildest

Between = Literal["any", "decisions", "checkpoints"]


@dataclass(frozen=True)
class OperatorInfo:
    """What is known of an operator variant without importing torch."""

    name: str  # in specs
    title: str  # in tables
    target: str  # import string of the `Operator` class
    low: float  # smallest severity value
    high: float  # largest severity value
    unit: str  # meaning of the severity value, for people
    simulated: bool = True
    """False for people and their clones: their commands do not follow from a rule and the seed
    alone.
    """
    tried: tuple[float, ...] = ()
    """The severities that `auto` tries, from the mildest to the worst; empty: some spread evenly
    over the range, whose end `high` is taken for the worst.
    """
    harmless: float | None = None
    """A severity milder than all of these, at which the operator is the unimpaired expert; None:
    there is none.
    """
    between: Between = "any"
    """What lies between two of them. `any`: every number. `decisions`: delays of whole decisions,
    which `tried` counts. `checkpoints`: nothing, and `auto` tries those of `expert.checkpoints`.
    """

    def ladder(self) -> tuple[float, ...]:
        """Return what `auto` tries where that are no checkpoints, from the mildest to the worst."""
        if self.tried:
            return self.tried
        first = 0 if self.harmless is None else 1
        step = (self.high - self.low) / SPREAD
        return tuple(self.low + step * number for number in range(first, SPREAD + 1))


PERSON = "person"  # the variant of people, who drive with `wasp drive`
CLONED = "cloned"  # the variant of their clones, which `wasp clone` makes

OPERATORS: Registry[OperatorInfo] = Registry(
    "operator variant",
    "wasp.operators",
    (
        OperatorInfo(
            "noisy",
            "Noisy",
            "wasp_cli.operators.noisy:NoisyOperator",
            0.0,
            1.0,
            "probability of a uniform action",
            tried=(0.2, 0.4, 0.6, 0.8, 1.0),
            harmless=0.0,
        ),
        OperatorInfo(
            "noisy-gaussian",
            "Noisy, Gaussian",
            "wasp_cli.operators.gaussian:GaussianNoiseOperator",
            0.0,
            2.0,
            "standard deviation of what is added to the command",
            tried=(0.25, 0.5, 1.0, 1.5, 2.0),
            harmless=0.0,
        ),
        OperatorInfo(
            "noisy-burst",
            "Noisy, bursts",
            "wasp_cli.operators.burst:BurstNoiseOperator",
            0.0,
            1.0,
            "share of the decisions within bursts of uniform actions",
            tried=(0.2, 0.4, 0.6, 0.8, 1.0),
            harmless=0.0,
        ),
        OperatorInfo(
            "laggy",
            "Laggy",
            "wasp_cli.operators.laggy:LaggyOperator",
            0.0,
            1.0,
            "probability of repeating the last command",
            tried=(0.4, 0.6, 0.8, 0.9, 1.0),
            harmless=0.0,
        ),
        OperatorInfo(
            "limited-skill",
            "Limited skill",
            "wasp_cli.operators.limited:LimitedSkillOperator",
            0.0,
            1.0,
            "fraction of the expert's interactions",
            between="checkpoints",
        ),
        OperatorInfo(
            "reaction-time",
            "Reaction time",
            "wasp_cli.operators.delayed:DelayedOperator",
            0.0,
            10.0,
            "delay in seconds",
            tried=(1.0, 2.0, 4.0, 8.0, 16.0, 32.0),
            between="decisions",
        ),
        OperatorInfo(
            "delayed-noisy",
            "Delayed and noisy",
            "wasp_cli.operators.delayed_noisy:DelayedNoisyOperator",
            0.0,
            1.0,
            "probability of a uniform action, at a delay of 0.16 seconds",
            tried=(0.0, 0.2, 0.4, 0.6, 0.8, 1.0),
        ),
        OperatorInfo(
            "reactive",
            "Reactive",
            "wasp_cli.operators.reactive:ReactiveOperator",
            0.0,
            1.0,
            "lag of the stick: share of the way to the intended command that is left after "
            "a decision",
            tried=(0.4, 0.6, 0.8, 0.9, 1.0),
            harmless=0.0,
        ),
        OperatorInfo(
            PERSON,
            "Person",
            "wasp_cli.operators.person:PersonOperator",
            0.0,
            9999.0,
            "number of the participant",
            simulated=False,
        ),
        OperatorInfo(
            CLONED,
            "Clone of a person",
            "wasp_cli.operators.cloned_person:CloneOfPerson",
            0.0,
            9999.0,
            "number of the participant whom `wasp clone` has cloned",
            simulated=False,
        ),
    ),
)

UNIMPAIRED = "none"  # the variant of the Expert row: the full-skill policy without an impairment
