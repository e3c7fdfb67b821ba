"""The facts of an episode and of a decision; None is undefined.

Letters: T decisions of the episode, A actions, L residual steps, I iterations of the planner.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wasp_cli.report.explain.stored import Constants
from wasp_cli.store.tables import Thresholds

State = Literal["fired", "silent", "not asked", "no candidate", "withheld", "late", "off", "unknown"]
"""Of a gate. `no candidate`: no tried correction was predicted to be safe. `withheld`: the one that gains is not, or changes no force.
`late`: nor was any gate asked in time. `off`: this variant of the method does without it."""

Range = tuple[float, float]
"""Least and greatest."""


@dataclass(frozen=True)
class Who:
    """Which episode."""

    key: str | None
    label: str
    path: str
    task: str
    method: str
    variant: str
    operator: str
    value: float | None
    seed: int
    episode: int
    episodes: int
    """in the cell"""
    episode_seed: int
    """of the world"""
    decisions: int


@dataclass(frozen=True)
class Totals:
    """Of a whole episode."""

    return_: float
    cost: int
    """env steps with cost"""
    goals: int
    success: bool
    costly: tuple[int, ...]
    """decisions with cost"""
    missed: tuple[int, ...]
    """decisions with cost and no gate"""
    late: tuple[int, ...]
    """decisions with cost while the assistant was late: no gate was asked"""
    intervened: tuple[int, ...]
    """decisions whose executed action is not the command"""
    int_rate: float
    mag_int: float | None
    gate_share: Mapping[str, float]
    """share of decisions, by name of the gate"""
    case2: float | None
    """share of Case II among the planner's iterations"""
    decision_p50_ms: float | None
    decision_p95_ms: float | None


@dataclass(frozen=True)
class Run:
    """Consecutive decisions under one gate, or, where runs were merged, under several."""

    first: int
    last: int
    gates: Mapping[str, int]
    """decisions by name of the gate"""
    command: tuple[float, ...]
    """[A] mean a^H"""
    executed: tuple[float, ...]
    """[A] mean a"""
    deviation: float
    """mean"""
    intervened: int
    """decisions"""
    g_cost: Range | None
    delta_g: Range | None
    signal: Range | None
    cost: int
    """env steps with cost"""
    costly: tuple[int, ...]
    """decisions with cost"""
    missed: tuple[int, ...]

    @property
    def decisions(self) -> int:
        """Return how many."""
        return self.last - self.first + 1

    @property
    def gate(self) -> str:
        """Return the most frequent gate."""
        return max(self.gates, key=self.gates.__getitem__)


@dataclass(frozen=True, eq=False)
class EpisodeSummary:
    """An episode as facts."""

    who: Who
    thresholds: Thresholds
    constants: Constants
    gated: bool
    """whether the method has WASP's gates"""
    selective: bool
    """whether it can miss a cost: it decides when to intervene"""
    totals: Totals
    runs: tuple[Run, ...]
    """Of one gate each; where one gate holds throughout, stretches with and without cost."""
    series: Mapping[str, NDArray[Any]]
    """[T] each: `gate` (metrics.episode.GATE_*), `g_cost`, `deviation`, `cost_env`"""
    signal_limit: float | None
    """what the method's own signal must exceed for an intervention"""


@dataclass(frozen=True)
class Gate:
    """A gate at one decision."""

    state: State
    value: float | None
    threshold: float | None

    @property
    def above(self) -> bool:
        """Tell whether the value exceeds the threshold."""
        return exceeds(self.value, self.threshold)


@dataclass(frozen=True)
class Planned:
    """What the planner did at one decision."""

    safe: tuple[int, ...]
    """[I] |F_s| (Eq. 14); empty where the plan was carried out without a search"""
    case2: tuple[bool, ...]
    """[I]"""
    residuals: tuple[tuple[float, ...], ...]
    """[L, A]"""
    cost: float | None
    """predicted cost return with the sequence"""
    return_: float | None
    alone_cost: float | None
    """without it, on the same rollouts"""
    alone_return: float | None

    @property
    def searched(self) -> bool:
        """Tell whether a search found the sequence. Files of earlier versions have -1 in the first iteration where none did."""
        return bool(self.safe) and self.safe[0] != -1

    @property
    def empty(self) -> bool:
        """Tell whether the sequence leaves every command as it is."""
        return not any(any(step) for step in self.residuals)


@dataclass(frozen=True)
class Happened:
    """What really happened in some decisions."""

    first: int
    last: int
    reward: float
    cost: int
    """env steps with cost"""
    costly: int
    """decisions with cost"""
    goals: int
    intervened: int
    """decisions"""
    discounted: float | None
    """costly decisions, discounted by gamma_c as predictions are; None where gamma_c is not known"""

    @property
    def decisions(self) -> int:
        """Return how many."""
        return self.last - self.first + 1


@dataclass(frozen=True)
class DecisionFacts:
    """One decision as facts."""

    who: Who
    constants: Constants
    t: int
    gate: str
    command: tuple[float, ...]
    """[A] a^H"""
    executed: tuple[float, ...]
    """[A] a"""
    deviation: float
    intervened: bool
    safety: Gate | None
    """None of a method without WASP's gates"""
    task: Gate | None
    g_return: float | None
    signal: float | None
    tau_q: float | None
    tau_c: float | None
    signal_limit: float | None
    """what the signal must exceed for an intervention"""
    plan: Planned | None
    now: Happened
    """this decision"""
    ahead: Happened
    """this decision and those behind it: `window` in all, or as many as are left"""
    window: int
    ms: float | None
    """decision time divided by the episodes that were decided side by side"""


def exceeds(value: float | None, limit: float | None) -> bool:
    """Tell whether a stored value is above a threshold. Gates compare in single precision, and rows hold it."""
    return value is not None and limit is not None and bool(np.float32(value) > np.float32(limit))


def as_json(facts: EpisodeSummary | DecisionFacts) -> dict[str, Any]:
    """Convert facts to JSON values; what is undefined is null."""
    plain: dict[str, Any] = plain_values(asdict(facts))
    return plain


def plain_values(value: Any) -> Any:
    """Convert to JSON values: no NaN, and seven digits, which is all that single precision has."""
    if isinstance(value, Mapping):
        return {str(name).rstrip("_"): plain_values(part) for name, part in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain_values(part) for part in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else None
    return value
