"""From the stored rows to the facts of one decision: command, gates, plan, what then happened."""

from __future__ import annotations

import numpy as np

from wasp_cli.metrics.episode import GATE_METHOD, GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.facts import Gate, Happened, Look, Planned, State
from wasp_cli.report.explain.stored import GATES, PREDICTED, Episode, number
from wasp_cli.report.explain.tell import unknown, who

WINDOW = 15
"""Decisions over which real costs are counted where no horizon H is known; the paper's H and W."""


def look(episode: Episode, t: int) -> Look:
    """The facts of one decision.

    Raises:
        UsageError: the episode has no such decision.
    """
    episode.require(t)
    horizon = episode.constants.horizon
    window = WINDOW if horizon is None or horizon == 1 else horizon  # `no-rollout` sees one step, but costs take longer to come
    return Look(
        who=who(episode),
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
        signal_limit=episode.signal_limit,
        plan=_plan(episode, t),
        now=_happened(episode, t, 1),
        ahead=_happened(episode, t, window),
        window=window,
        ms=number(float(episode.ms[t])) if t < len(episode.ms) else None,
        unknown=unknown(episode),
    )


def _safety(episode: Episode, t: int) -> Gate:
    value = episode.at("g_cost", t)
    state: State = "silent"
    if episode.gate[t] == GATE_SAFETY:
        state = "fired"
    elif episode.row["assistant_variant"] == "task-only":
        state = "off"
    elif value is None:
        state = "unknown"
    return Gate(state, value, episode.thresholds.tau_c)


def _task(episode: Episode, t: int) -> Gate:
    value = episode.at("delta_g", t)
    state: State = "silent"
    if episode.gate[t] == GATE_TASK:
        state = "fired"
    elif episode.row["assistant_variant"] == "safety-only":
        state = "off"
    elif episode.gate[t] == GATE_SAFETY:
        state = "not asked"
    elif value is None:  # where a cost return is known the decision has been recorded, and so would be a gain
        state = "unknown" if episode.gate[t] == GATE_METHOD or episode.at("g_cost", t) is None else "no candidate"
    return Gate(state, value, episode.thresholds.tau_r)


def _plan(episode: Episode, t: int) -> Planned | None:
    safe, case2, plan = episode.safe[t], episode.case2[t], episode.plan[t]
    if safe is None or case2 is None or plan is None:
        return None
    actions = episode.a.shape[1]
    residuals = tuple(plan[k : k + actions] for k in range(0, len(plan), actions))
    return Planned(safe, case2, residuals, *(episode.at(name, t) for name in PREDICTED))


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
