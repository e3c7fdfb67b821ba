"""The operator variants by name. To add one, write a module with its class, and add one entry here
or an entry point.
"""

from __future__ import annotations

from dataclasses import dataclass

from wasp_cli.registry import Registry


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
        ),
        OperatorInfo(
            "noisy-gaussian",
            "Noisy, Gaussian",
            "wasp_cli.operators.gaussian:GaussianNoiseOperator",
            0.0,
            2.0,
            "standard deviation of what is added to the command",
        ),
        OperatorInfo(
            "noisy-burst",
            "Noisy, bursts",
            "wasp_cli.operators.burst:BurstNoiseOperator",
            0.0,
            1.0,
            "share of the decisions within bursts of uniform actions",
        ),
        OperatorInfo(
            "laggy",
            "Laggy",
            "wasp_cli.operators.laggy:LaggyOperator",
            0.0,
            1.0,
            "probability of repeating the last command",
        ),
        OperatorInfo(
            "limited-skill",
            "Limited skill",
            "wasp_cli.operators.limited:LimitedSkillOperator",
            0.0,
            1.0,
            "fraction of the expert's interactions",
        ),
        OperatorInfo(
            "reaction-time",
            "Reaction time",
            "wasp_cli.operators.delayed:DelayedOperator",
            0.0,
            10.0,
            "delay in seconds",
        ),
        OperatorInfo(
            "delayed-noisy",
            "Delayed and noisy",
            "wasp_cli.operators.delayed_noisy:DelayedNoisyOperator",
            0.0,
            1.0,
            "probability of a uniform action, at a delay of 0.16 seconds",
        ),
        OperatorInfo(
            "reactive",
            "Reactive",
            "wasp_cli.operators.reactive:ReactiveOperator",
            0.0,
            1.0,
            "lag of the stick: share of the way to the intended command that is left after "
            "a decision",
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
