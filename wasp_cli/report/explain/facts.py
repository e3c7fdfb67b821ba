"""From the stored rows to facts, and from facts to JSON: an episode's totals and runs of decisions
under one gate; one decision.

None is undefined. Letters: A actions, L residual steps, I iterations of the planner.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from wasp_cli.cells.table import Floats
from wasp_cli.metrics.episode import GATE_LATE, GATE_METHOD, GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.episode import GATES, PREDICTED, Bools, Episode, number

State = Literal[
    "fired", "silent", "not asked", "no candidate", "withheld", "late", "off", "unknown"
]
"""The state of a gate. `not asked`: the safety gate fired first. `no candidate`: no correction that
was tried was predicted to be safe. `withheld`: the correction that gains is not safe, or changes no
force. `late`: the assistant did not answer in time. `off`: the method, or this variant of it, has
no such gate.
"""

Range = tuple[float, float]  # least and greatest

# decisions over which real costs are counted if the horizon H is not known; the paper's H and W
WINDOW = 15


@dataclass(frozen=True)
class Run:
    """Consecutive decisions `first` to `last` under one gate, or several gates if runs were
    merged.
    """

    first: int
    last: int
    gates: Mapping[str, int]  # decisions by name of the gate
    command: tuple[float, ...]  # [A] mean a^H
    executed: tuple[float, ...]  # [A] mean a
    deviation: float  # mean
    intervened: int  # decisions
    g_cost: Range | None
    delta_g: Range | None
    signal: Range | None
    cost: int  # env steps with cost
    costly: tuple[int, ...]  # decisions with cost
    missed: tuple[int, ...]

    @property
    def decisions(self) -> int:
        """How many decisions the run has."""
        return self.last - self.first + 1

    @property
    def gate(self) -> str:
        """The gate that most of its decisions have."""
        return max(self.gates, key=self.gates.__getitem__)


@dataclass(frozen=True)
class Gate:
    """What one gate said at a decision: its state, and the value that it compared with its
    threshold.
    """

    state: State
    value: float | None
    threshold: float | None


@dataclass(frozen=True)
class Planned:
    """The plan of a decision: the search, the sequence of residuals it chose, and what was
    predicted.
    """

    # [I] |F_s| (Eq. 14); empty where the plan was carried out without a search
    safe: tuple[int, ...]
    case2: tuple[bool, ...]  # [I]
    residuals: tuple[tuple[float, ...], ...]  # [L, A]
    cost: float | None  # predicted cost return with the sequence
    return_: float | None
    alone_cost: float | None  # without it, on the same rollouts
    alone_return: float | None

    @property
    def searched(self) -> bool:
        """Whether a search found the sequence. Files of earlier versions have -1 in the first
        iteration if none did.
        """
        return bool(self.safe) and self.safe[0] != -1

    @property
    def empty(self) -> bool:
        """Whether the chosen sequence corrects nothing: all residuals are zero."""
        return not any(any(step) for step in self.residuals)


@dataclass(frozen=True)
class Happened:
    """What really happened at decisions `first` to `last`."""

    first: int
    last: int
    reward: float
    cost: int  # env steps with cost
    costly: int  # decisions with cost
    goals: int
    intervened: int  # decisions
    # costly decisions, discounted by gamma_c as predictions are; None where gamma_c is not known
    discounted: float | None


@dataclass(frozen=True)
class Decision:
    """Everything that is stored about decision `t` of an episode."""

    t: int
    gate: str
    command: tuple[float, ...]  # [A] a^H
    executed: tuple[float, ...]  # [A] a
    deviation: float
    intervened: bool
    safety: Gate | None  # None of a method without WASP's gates
    task: Gate | None
    g_return: float | None
    signal: float | None
    plan: Planned | None
    now: Happened  # this decision
    ahead: Happened  # this decision and those behind it: `window` in all, or as many as are left
    window: int
    ms: float | None  # decision time divided by the episodes that were decided side by side


def runs_of(episode: Episode) -> tuple[Run, ...]:
    """Return the runs of an episode: consecutive decisions under one gate. If the gate never
    changes, they are stretches with and without cost instead.
    """
    marks = episode.gate
    if len(set(episode.gate.tolist())) == 1:
        marks = episode.costly.astype(np.int64)
    bounds = [0, *(np.flatnonzero(np.diff(marks)) + 1).tolist(), episode.decisions]
    return tuple(_run(episode, first, end) for first, end in pairwise(bounds))


def _run(episode: Episode, first: int, end: int) -> Run:
    part = slice(first, end)
    numbers = episode.numbers
    return Run(
        first=first,
        last=end - 1,
        gates=dict(Counter(GATES[value] for value in episode.gate[part].tolist())),
        command=_tuple(episode.a_h[part].mean(0)),
        executed=_tuple(episode.a[part].mean(0)),
        deviation=float(numbers["deviation"][part].mean()),
        intervened=int(episode.intervened[part].sum()),
        g_cost=_range(numbers["g_cost"][part]),
        delta_g=_range(numbers["delta_g"][part]),
        signal=_range(numbers["signal"][part]),
        cost=int(numbers["cost_env"][part].sum()),
        costly=tuple(first + t for t in places_of(episode.costly[part])),
        missed=tuple(first + t for t in places_of(episode.missed[part])),
    )


def merged_runs(episode: Episode, most: int) -> tuple[Run, ...]:
    """Return the runs of an episode, merged into at most `most`. The shortest ones are merged with
    a neighbour first, and those without a gate before those of a gate.
    """
    pieces = list(runs_of(episode))
    while len(pieces) > max(most, 1):
        # The shortest run; a decision of a gate counts as three without one.
        weights = [run.decisions * (1 if run.gate == "none" else 3) for run in pieces]
        i = weights.index(min(weights))

        # It joins both neighbours if they have the same gate, else the shorter one.
        left = max(i - 1, 0)
        right = min(i + 1, len(pieces) - 1)
        if left < i < right and pieces[left].gate != pieces[right].gate:
            if pieces[right].decisions <= pieces[left].decisions:
                left = i
            else:
                right = i
        pieces[left : right + 1] = [_run(episode, pieces[left].first, pieces[right].last + 1)]
    return tuple(pieces)


def decision_of(episode: Episode, t: int) -> Decision:
    """Return what is stored about decision t. Raises UsageError if the episode does not have it."""
    episode.require(t)
    horizon = episode.constants.horizon
    # The variant `no-rollout` has a horizon of one step, after which few costs have come yet.
    window = WINDOW if horizon is None or horizon == 1 else horizon
    return Decision(
        t=t,
        gate=GATES[int(episode.gate[t])],
        command=_tuple(episode.a_h[t]),
        executed=_tuple(episode.a[t]),
        deviation=float(episode.numbers["deviation"][t]),
        intervened=bool(episode.intervened[t]),
        safety=_safety(episode, t) if episode.gated else None,
        task=_task(episode, t) if episode.gated else None,
        g_return=episode.at("g_return", t),
        signal=episode.at("signal", t),
        plan=_plan(episode, t),
        now=_happened(episode, t, 1),
        ahead=_happened(episode, t, window),
        window=window,
        ms=number(float(episode.ms[t])) if t < len(episode.ms) else None,
    )


def _safety(episode: Episode, t: int) -> Gate:
    value = episode.at("g_cost", t)
    state: State = "silent"
    if episode.gate[t] == GATE_SAFETY:
        state = "fired"
    elif episode.variant == "task-only":
        state = "off"
    elif episode.gate[t] == GATE_LATE:
        state = "late"
    elif value is None:
        state = "unknown"
    return Gate(state, value, episode.thresholds.tau_c)


def _task(episode: Episode, t: int) -> Gate:
    value = episode.at("delta_g", t)
    state: State = "silent"
    if episode.gate[t] == GATE_TASK:
        state = "fired"
    elif not episode.asks_task:
        state = "off"
    elif episode.gate[t] == GATE_LATE:
        state = "late"
    elif episode.gate[t] == GATE_SAFETY:
        state = "not asked"
    elif episode.constants.takeover and exceeds(value, episode.thresholds.tau_r):
        state = "withheld"
    elif value is None:
        # If the cost return is recorded, a gain would be recorded too.
        if episode.gate[t] == GATE_METHOD or episode.at("g_cost", t) is None:
            state = "unknown"
        else:
            state = "no candidate"
    return Gate(state, value, episode.thresholds.tau_r)


def _plan(episode: Episode, t: int) -> Planned | None:
    plan = episode.plan[t]
    if plan is None:
        return None
    actions = episode.a.shape[1]
    residuals = tuple(plan[k : k + actions] for k in range(0, len(plan), actions))
    return Planned(
        episode.safe[t] or (),
        episode.case2[t] or (),
        residuals,
        *(episode.at(name, t) for name in PREDICTED),
    )


def _happened(episode: Episode, t: int, window: int) -> Happened:
    end = min(t + window, episode.decisions)
    part = slice(t, end)
    gamma = episode.constants.gamma_c
    costly = episode.costly[part]
    discounted = None
    if gamma is not None:
        discounted = float((gamma ** np.arange(len(costly)))[costly].sum())
    return Happened(
        first=t,
        last=end - 1,
        reward=float(episode.numbers["reward"][part].sum()),
        cost=int(episode.numbers["cost_env"][part].sum()),
        costly=int(costly.sum()),
        goals=int(episode.numbers["goals"][part].sum()),
        intervened=int(episode.intervened[part].sum()),
        discounted=discounted,
    )


def exceeds(value: float | None, limit: float | None) -> bool:
    """Return whether a stored value is above a threshold, compared in single precision as gates do;
    False if either is unknown.
    """
    return value is not None and limit is not None and bool(np.float32(value) > np.float32(limit))


def places_of(marks: Bools) -> tuple[int, ...]:
    """Return the indices of those marks [T] that are set."""
    return tuple(np.flatnonzero(marks).tolist())


def _tuple(values: Floats) -> tuple[float, ...]:
    return tuple(values.tolist())


def _range(values: Floats) -> Range | None:
    defined = values[np.isfinite(values)]
    if not len(defined):
        return None
    return float(defined.min()), float(defined.max())


def episode_json(episode: Episode) -> dict[str, Any]:
    """Return the totals, runs and series of an episode as JSON values; None is undefined."""
    row = episode.row
    names = ("g_cost", "deviation", "cost_env")
    shares = {
        name: float((episode.gate == value).mean())
        for value, name in GATES.items()
        if (episode.gate == value).any()
    }
    totals = {
        "return": row["return"],
        "cost": row["cost"],
        "goals": row["goals"],
        "success": row["success"],
        "costly": places_of(episode.costly),
        "missed": places_of(episode.missed),
        "late": places_of(episode.late),
        "intervened": places_of(episode.intervened),
        "int_rate": row["int_rate"],
        "mag_int": row["mag_int"],
        "gate_share": shares,
        "case2": row["case2"],
        "decision_p50_ms": row["decision_p50_ms"],
        "decision_p95_ms": row["decision_p95_ms"],
    }
    facts = {
        "who": _who(episode),
        "thresholds": asdict(episode.thresholds),
        "constants": asdict(episode.constants),
        "gated": episode.gated,
        "selective": episode.selective,
        "totals": totals,
        "runs": [asdict(run) for run in runs_of(episode)],
        "series": {"gate": episode.gate, **{name: episode.numbers[name] for name in names}},
        "signal_limit": episode.signal_limit,
    }
    return dict(plain_values(facts))


def decision_json(episode: Episode, t: int) -> dict[str, Any]:
    """Return `decision_of` as JSON values, with the thresholds. Raises UsageError as it does."""
    limits = {
        "tau_q": episode.thresholds.tau_q,
        "tau_c": episode.thresholds.tau_c,
        "signal_limit": episode.signal_limit,
    }
    facts = {
        "who": _who(episode),
        "constants": asdict(episode.constants),
        **asdict(decision_of(episode, t)),
        **limits,
    }
    return dict(plain_values(facts))


def _who(episode: Episode) -> dict[str, Any]:
    names = ("task", "method", "variant", "operator", "value", "seed", "episode")
    return {
        "key": episode.cell.key,
        "label": episode.label,
        "path": str(episode.cell.path),
        **{name: episode.row[name] for name in names},
        "episodes": episode.episodes,
        "episode_seed": episode.row["episode_seed"],
        "decisions": episode.decisions,
    }


def plain_values(value: Any) -> Any:
    """Convert to JSON values. NaN and infinity become None, and numbers have the seven digits of
    single precision.
    """
    if isinstance(value, Mapping):
        return {str(name).rstrip("_"): plain_values(part) for name, part in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain_values(part) for part in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else None
    return value
