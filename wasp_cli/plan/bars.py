"""The bars that stages should reach, and what to do if one does not.

Each bar follows from the environment itself: from the return and cost of zero and random commands
there, the base rate of its costs, and the expert's own return. The numbers are in the summary of a
manifest. Bars are in no key, so that results which were stored before a bar existed are judged by
it too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

Summary = Mapping[str, Any]

CLEAR = 2.0  # standard errors by which an expert has to beat commands that know nothing
COSTLY_ROWS = 100
"""Costly decisions that a dataset should have. A lander's 204, one in an episode, were enough to
foresee its crashes; the least of this package's tasks has twenty times as many.
"""
FORESEEN = 0.25
"""Share of what the best trivial forecast leaves (1 minus its AUPRC) that the model has to foresee.
The published models of this package foresee .42 or more.
"""
JUDGED = (1, 5)  # imagined decisions ahead: at the start and at a third of the gates' horizon
EXPLAINED = 0.1  # share of the variance of rewards, beside a forecast of their mean
KEPT = 0.85  # share of the teacher's return above random commands
FAR_ABOVE = 2.0
"""Times its limit that an expert may cost at the end of its training, where it explores."""
COST_RATIO = 1.3  # of the latent expert's cost to its teacher's
COST_SLACK = 0.25
"""Share of the way from the teacher's cost to that of random commands, which the latent expert may
go where that is more.
"""
UNCONSTRAINED = 0.5  # share of the cost rate of random commands
ALWAYS = 0.95  # share of the expert's decisions at which a gate fires in effect always


@dataclass(frozen=True)
class Shortfall:
    """How a node falls short of a bar, with the numbers, and what to do about it."""

    sentence: str  # begins small, and ends without a point
    remedy: str


@dataclass(frozen=True)
class Measured:
    """What is known about a node: the summary of its stage, the settings that it ran with, and the
    summaries of the stages that it builds on, by kind.
    """

    summary: Summary
    config: Summary
    behind: Mapping[str, Summary]


def shortfalls(kind: str, measured: Measured) -> list[Shortfall]:
    """Return how a node falls short of the bars of its stage.

    Numbers that are missing are not judged, since earlier versions measured fewer.
    """
    judge = BARS.get(kind)
    if judge is None:
        return []
    return judge(measured)


def _expert(measured: Measured) -> list[Shortfall]:
    """Whether the expert beats zero and random commands in the same worlds, and keeps its limit."""
    summary = measured.summary
    config = measured.config
    found: list[Shortfall] = []

    # Its return, clearly above that of zero and of random commands.
    returned = _number(summary, "return")
    if returned is not None:
        unbeaten = []
        for name in ("zero", "random"):
            reference = summary.get(name)
            if not isinstance(reference, Mapping):
                continue
            other = _number(reference, "return")
            if other is None:
                continue
            if returned - other <= CLEAR * _error_of_difference(summary, reference):
                unbeaten.append(f"{name} commands {_short(other)}")
        if unbeaten:
            found.append(
                Shortfall(
                    f"the expert returns {_short(returned)} an episode, and does not clearly beat "
                    f"{' and '.join(unbeaten)}",
                    "give it more `expert.interactions`, a vector that says where things are, or "
                    "a reward that tells progress",
                )
            )

    # Its cost: whether the multiplier of the limit ended at its floor or at its ceiling.
    cost = _number(summary, "cost_per_1000")
    limit = _limit(measured)
    multiplier = _number(summary, "multiplier")
    lowest = _number(config, "multiplier_min")
    highest = _number(config, "multiplier_max")
    if cost is None or multiplier is None:
        return found
    random = _number(summary.get("random"), "cost_per_1000")
    at_floor = lowest is not None and multiplier <= lowest
    at_ceiling = highest is not None and multiplier >= highest
    if at_floor and random is not None and cost > UNCONSTRAINED * random:
        found.append(
            Shortfall(
                f"the expert was never constrained: its multiplier ended at its floor of "
                f"{_short(multiplier)}, and it costs {_short(cost)} per 1000 env steps, random "
                f"commands {_short(random)}",
                "lower `expert.cost_limit`, or write `auto`",
            )
        )
    training = _number(summary, "training_cost_per_1000")
    if training is not None and limit is not None and training > FAR_ABOVE * limit:
        found.append(
            Shortfall(
                f"the expert does not keep its limit of {_short(limit)} per 1000 env steps: in the "
                f"last tenth of its training it still cost {_short(training)}",
                "give it more `expert.interactions`: the assistants learn from it what is safe",
            )
        )
    elif at_ceiling and limit is not None and cost > limit:
        found.append(
            Shortfall(
                f"the expert's limit of {_short(limit)} per 1000 env steps is out of its reach: "
                f"its multiplier ended at its ceiling of {_short(multiplier)}, and it costs "
                f"{_short(cost)}",
                "give it more `expert.interactions`, or raise `expert.cost_limit`",
            )
        )
    return found


def _limit(measured: Measured) -> float | None:
    """The limit in force: the one that the stage chose, else that of its section."""
    config = measured.config
    late = _number(config, "late_cost_limit")
    chosen = _number(measured.summary, "cost_limit")
    if late is not None:
        return late
    return _number(config, "cost_limit") if chosen is None else chosen


def _dataset(measured: Measured) -> list[Shortfall]:
    """Whether there is enough to learn a cost from."""
    summary = measured.summary
    found = []
    share = _number(summary, "costly_share")
    steps = _number(summary, "steps")
    if share is not None and steps is not None:
        costly = round(share * steps)
        if costly < COSTLY_ROWS:
            most = summary.get("most_costly")
            whose = f", most of them {most}" if isinstance(most, str) and costly else ""
            found.append(
                Shortfall(
                    f"{costly} of {steps:,.0f} recorded decisions cost ({share:.2%}){whose}: too "
                    f"few to learn a cost from, which takes about {COSTLY_ROWS}",
                    "raise `dataset.steps`, or the shares of `careless` and `bursts` in "
                    "`dataset.mixture`",
                )
            )
    unseen = _number(summary, "sources_not_seen")
    if unseen:
        names = summary.get("unseen_sources")
        which = f" ({names})" if isinstance(names, str) else ""
        found.append(
            Shortfall(
                f"{unseen:.0f} of the environment's cost sources{which} never cost in the dataset: "
                "nothing can be learned of them",
                "raise `dataset.steps`, or leave them out of `cost_sources`",
            )
        )
    return found


def _diagnostics(measured: Measured) -> list[Shortfall]:
    """How well costs and rewards are imagined, beside baselines that need no model."""
    summary = measured.summary
    blind: list[str] = []
    if _number(summary, f"base@{JUDGED[0]}") == 0.0:
        blind.append("nothing cost in the held-out episodes")
    for step in JUDGED:
        seen = _number(summary, f"auprc@{step}")
        base = _number(summary, f"base@{step}")
        if seen is None or base is None:
            continue
        lasting = _number(summary, f"persistence@{step}")
        trivial = base if lasting is None else max(base, lasting)
        if seen < trivial + FORESEEN * (1.0 - trivial):
            beside = "" if lasting is None else f", with a cost that stays as it is {lasting:.2f}"
            blind.append(f"{_ahead(step)} AUPRC {seen:.2f} (by chance {base:.2g}{beside})")
    found: list[Shortfall] = []
    if blind:
        found.append(
            Shortfall(
                f"the world model does not know the cost: {'; '.join(blind)}",
                "see with `wasp try` whether an image shows what will cost; another camera, more "
                "costly decisions in the dataset, or a larger preset may help",
            )
        )
    unexplained = [
        f"{_ahead(step)} {value:.2f}"
        for step in JUDGED
        if (value := _number(summary, f"reward_r2@{step}")) is not None and value < EXPLAINED
    ]
    if unexplained:
        found.append(
            Shortfall(
                f"the world model foresees rewards no better than their mean: R2 "
                f"{', '.join(unexplained)}",
                "raise `world_model.updates` or the preset; a reward at rare moments needs more "
                "`dataset.steps`",
            )
        )
    return found


def _policies(measured: Measured) -> list[Shortfall]:
    """The latent expert beside its privileged teacher in the same worlds."""
    summary = measured.summary
    found = []
    latent = _number(summary, "return")
    teacher = _number(summary, "privileged_return")
    random = measured.behind.get("expert", {}).get("random")
    nothing = _number(random, "return")
    if latent is not None and teacher is not None:
        zero = 0.0 if nothing is None else nothing
        gained = teacher - zero
        share = (latent - zero) / gained if gained > 0 else None
        if share is not None and share < KEPT:
            above = "" if nothing is None else f" above random commands ({_short(nothing)})"
            found.append(
                Shortfall(
                    f"the latent expert keeps {max(share, 0.0):.0%} of its teacher's "
                    f"return{above}, {_short(latent)} of {_short(teacher)}, which bounds every "
                    "assistant",
                    "raise `policies.labelling_rounds` and `policies.reinforce.interactions`, or "
                    "the preset; if the image does not show what the vector says, another camera",
                )
            )
    cost = _number(summary, "cost")
    allowed = _number(summary, "privileged_cost")
    at_random = _number(random, "cost")
    if cost is not None and allowed is not None and at_random is not None:
        most = max(COST_RATIO * allowed, allowed + COST_SLACK * (at_random - allowed))
        if cost > most:
            found.append(
                Shortfall(
                    f"the latent expert costs {_short(cost)} an episode, its teacher "
                    f"{_short(allowed)} and random commands {_short(at_random)}",
                    "raise `policies.reinforce.interactions`, or see whether the world model knows "
                    "the cost",
                )
            )
    return found


def _calibration(measured: Measured) -> list[Shortfall]:
    """How often the safety gate fires at an unimpaired expert's held-out decisions.

    A gate that never fires there is no shortfall, since the expert may be safe. Cells show whether
    it fires when operators err.
    """
    summary = measured.summary
    rate = _number(summary, "safety_rate")
    threshold = _number(summary, "tau_c")
    if rate is None or threshold is None:
        return []
    expected = _number(summary, "g_cost_p95")
    against = "" if expected is None else f"; 95 % of the expected costs are below {expected:.2g}"
    if rate >= ALWAYS:
        return [
            Shortfall(
                f"the safety gate fires at {rate:.0%} of the expert's held-out decisions: tau_c is "
                f"{_short(threshold)}{against}",
                "raise `tau_c`, or lower `expert.cost_limit`: who drives like the expert is "
                "corrected all the time",
            )
        ]
    return []


def _severity(measured: Measured) -> list[Shortfall]:
    """Whether some severity keeps the share of the return that was asked for."""
    summary = measured.summary
    operator = summary.get("operator")
    severity = _number(summary, "severity")
    asked = _number(measured.config, "kept")
    if summary.get("within") is not False or severity is None or asked is None:
        return []
    kept = _number(summary, "kept")
    expert = _number(summary, "expert_return")
    random = _number(summary, "random_return")
    if kept is None:
        if expert is None or random is None:
            return []
        return [
            Shortfall(
                f"no severity of {operator} could be measured: the latent expert returns "
                f"{_short(expert)} an episode, and random commands {_short(random)}; it drives at "
                f"{_short(severity)}, the middle of what is tried",
                "train a better expert first, or write a number for the severity",
            )
        ]
    if kept > asked:
        which = "the worst severity that is tried"
    else:
        which = "the mildest severity that is tried"
    return [
        Shortfall(
            f"{operator} keeps {kept:.0%} of the way from random commands to the latent expert at "
            f"{_short(severity)}, {which}: {asked:.0%} is out of its reach",
            "write another `severity.kept`, a number for the severity, or another operator",
        )
    ]


BARS: Mapping[str, Callable[[Measured], list[Shortfall]]] = {
    "expert": _expert,
    "dataset": _dataset,
    "diagnostics": _diagnostics,
    "policies": _policies,
    "calibration": _calibration,
    "severity": _severity,
}
"""By the kind of a stage, what holds it against its bars."""


def _number(values: object, name: str) -> float | None:
    """A finite number of a summary; None if there is none."""
    value = values.get(name) if isinstance(values, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def _error_of_difference(one: Summary, other: Summary) -> float:
    """Standard error of the difference of two mean returns; 0 if it is not known."""
    return math.hypot(_number(one, "return_se") or 0.0, _number(other, "return_se") or 0.0)


def _short(value: float) -> str:
    return f"{value:.3g}"


def _ahead(step: int) -> str:
    return "one decision ahead" if step == 1 else f"{step} ahead"
