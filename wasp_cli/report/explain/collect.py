"""From the stored rows to facts: an episode's totals and runs of decisions under one gate; one decision with its gates and plan."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from wasp_cli.metrics.episode import GATE_LATE, GATE_METHOD, GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.facts import (
    DecisionFacts,
    EpisodeSummary,
    Gate,
    Happened,
    Planned,
    Range,
    Run,
    State,
    Totals,
    Who,
    exceeds,
)
from wasp_cli.report.explain.stored import GATES, PREDICTED, Bools, Episode, Floats, number

WINDOW = 15
"""Decisions over which real costs are counted where no horizon H is known; the paper's H and W."""


def summarize(episode: Episode) -> EpisodeSummary:
    """Summarize an episode."""
    row, gate = episode.row, episode.gate
    totals = Totals(
        return_=float(row["return"]),
        cost=int(row["cost"]),
        goals=int(row["goals"]),
        success=bool(row["success"]),
        costly=_places(episode.costly),
        missed=_places(episode.missed),
        late=_places(episode.late),
        intervened=_places(episode.intervened),
        int_rate=float(row["int_rate"]),
        mag_int=number(row["mag_int"]),
        gate_share={name: float((gate == value).mean()) for value, name in GATES.items() if (gate == value).any()},
        case2=number(row["case2"]),
        decision_p50_ms=number(row["decision_p50_ms"]),
        decision_p95_ms=number(row["decision_p95_ms"]),
    )
    series = {"gate": gate, **{name: episode.numbers[name] for name in ("g_cost", "deviation", "cost_env")}}
    return EpisodeSummary(
        identity(episode), episode.thresholds, episode.constants, episode.gated, episode.selective, totals, _runs(episode), series,
        episode.signal_limit,
    )  # fmt: skip


def merge_runs(runs: Sequence[Run], most: int) -> tuple[Run, ...]:
    """Merge the runs of an episode into at most `most`: short quiet ones join their neighbours first."""
    pieces = list(runs)
    while len(pieces) > max(most, 1):
        # A quiet decision between two of a gate says less than the gate: it goes before the others do.
        i = min(range(len(pieces)), key=lambda k: (pieces[k].decisions * (1 if pieces[k].gate == "none" else 3), k))
        left, right = max(i - 1, 0), min(i + 1, len(pieces) - 1)
        if left < i < right and pieces[left].gate != pieces[right].gate:
            left, right = (i, right) if pieces[right].decisions <= pieces[left].decisions else (left, i)
        pieces[left : right + 1] = [_joined(pieces[left : right + 1])]
    return tuple(pieces)


def _joined(runs: Sequence[Run]) -> Run:
    """Neighbouring runs as one."""
    sizes = [run.decisions for run in runs]
    gates: Counter[str] = Counter()
    for run in runs:
        gates.update(run.gates)
    return Run(
        first=runs[0].first,
        last=runs[-1].last,
        gates=dict(gates),
        command=_tuple(np.average([run.command for run in runs], 0, sizes)),
        executed=_tuple(np.average([run.executed for run in runs], 0, sizes)),
        deviation=float(np.average([run.deviation for run in runs], 0, sizes)),
        intervened=sum(run.intervened for run in runs),
        g_cost=_range([bound for run in runs for bound in run.g_cost or ()]),
        delta_g=_range([bound for run in runs for bound in run.delta_g or ()]),
        signal=_range([bound for run in runs for bound in run.signal or ()]),
        cost=sum(run.cost for run in runs),
        costly=tuple(t for run in runs for t in run.costly),
        missed=tuple(t for run in runs for t in run.missed),
    )


def _runs(episode: Episode) -> tuple[Run, ...]:
    marks = episode.gate if len(set(episode.gate.tolist())) > 1 else episode.costly.astype(np.int64)
    bounds = [0, *(np.flatnonzero(np.diff(marks)) + 1).tolist(), episode.decisions]
    return tuple(_run(episode, first, end) for first, end in pairwise(bounds))


def _run(episode: Episode, first: int, end: int) -> Run:
    """The decisions `first` ... `end - 1`."""
    part, numbers = slice(first, end), episode.numbers
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
        costly=tuple(first + t for t in _places(episode.costly[part])),
        missed=tuple(first + t for t in _places(episode.missed[part])),
    )


def decision_facts(episode: Episode, t: int) -> DecisionFacts:
    """Collect the facts of one decision.

    Raises:
        UsageError: the episode has no such decision.
    """
    episode.require(t)
    horizon = episode.constants.horizon
    window = WINDOW if horizon is None or horizon == 1 else horizon  # `no-rollout` sees one step, but costs take longer to come
    return DecisionFacts(
        who=identity(episode),
        constants=episode.constants,
        t=t,
        gate=GATES[int(episode.gate[t])],
        command=tuple(episode.a_h[t].tolist()),
        executed=tuple(episode.a[t].tolist()),
        deviation=float(episode.numbers["deviation"][t]),
        intervened=bool(episode.intervened[t]),
        safety=_safety(episode, t) if episode.gated else None,
        task=_task(episode, t) if episode.gated else None,
        g_return=episode.at("g_return", t),
        signal=episode.at("signal", t),
        tau_q=episode.thresholds.tau_q,
        tau_c=episode.thresholds.tau_c,
        signal_limit=episode.signal_limit,
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
    elif episode.row["variant"] == "task-only":
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
    elif episode.row["variant"] == "safety-only" or (episode.constants.takeover and episode.thresholds.tau_r is None):
        state = "off"
    elif episode.gate[t] == GATE_LATE:
        state = "late"
    elif episode.gate[t] == GATE_SAFETY:
        state = "not asked"
    elif episode.constants.takeover and exceeds(value, episode.thresholds.tau_r):
        state = "withheld"
    elif value is None:  # where a cost return is known the decision has been recorded, and so would be a gain
        state = "unknown" if episode.gate[t] == GATE_METHOD or episode.at("g_cost", t) is None else "no candidate"
    return Gate(state, value, episode.thresholds.tau_r)


def _plan(episode: Episode, t: int) -> Planned | None:
    plan = episode.plan[t]
    if plan is None:
        return None
    actions = episode.a.shape[1]
    residuals = tuple(plan[k : k + actions] for k in range(0, len(plan), actions))
    return Planned(episode.safe[t] or (), episode.case2[t] or (), residuals, *(episode.at(name, t) for name in PREDICTED))


def _happened(episode: Episode, t: int, window: int) -> Happened:
    """In the decisions from t on, `window` of them or as many as are left."""
    end = min(t + window, episode.decisions)
    part, gamma = slice(t, end), episode.constants.gamma_c
    costly = episode.costly[part]
    return Happened(
        first=t,
        last=end - 1,
        reward=float(episode.numbers["reward"][part].sum()),
        cost=int(episode.numbers["cost_env"][part].sum()),
        costly=int(costly.sum()),
        goals=int(episode.numbers["goals"][part].sum()),
        intervened=int(episode.intervened[part].sum()),
        discounted=None if gamma is None else float((gamma ** np.arange(len(costly)))[costly].sum()),
    )


def identity(episode: Episode) -> Who:
    """Return which episode it is."""
    row, cell = episode.row, episode.cell
    variant = "" if row["variant"] == "full" else f"/{row['variant']}"
    operator = "unimpaired" if row["value"] is None else f"{row['operator']}={row['value']:g}"
    return Who(
        key=cell.key,
        label=cell.label or f"{row['task']} s{row['seed']} {row['method']}{variant} {operator}",
        path=str(cell.path),
        task=row["task"],
        method=row["method"],
        variant=row["variant"],
        operator=row["operator"],
        value=row["value"],
        seed=row["seed"],
        episode=row["episode"],
        episodes=episode.episodes,
        episode_seed=row["episode_seed"],
        decisions=episode.decisions,
    )


def _places(marks: Bools) -> tuple[int, ...]:
    return tuple(np.flatnonzero(marks).tolist())


def _tuple(values: Floats) -> tuple[float, ...]:
    return tuple(values.tolist())


def _range(values: Floats | Sequence[float]) -> Range | None:
    defined = [value for value in np.asarray(values, np.float64).tolist() if math.isfinite(value)]
    return (min(defined), max(defined)) if defined else None
