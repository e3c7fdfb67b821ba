"""One decision as tables: the action, the gates, the plan, and what then happened."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import RenderableType
from rich.text import Text

from wasp_cli.metrics.episode import CUT_OFF, GATE_METHOD, GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.facts import Decision, Gate, Planned, decision_of, exceeds
from wasp_cli.report.explain.layout import (
    action,
    beside,
    cell_fields,
    cost_meaning,
    count,
    decider,
    fields,
    gain_meaning,
    heading,
    ms,
    notes,
    plain,
    section,
    set_out,
    short,
    span,
    table,
)
from wasp_cli.report.explain.stored import Episode
from wasp_cli.report.explain.timeline import LOOKS

FIRES = {
    "fired": "yes",
    "silent": "no",
    "not asked": "not asked: the safety gate fired",
    "no candidate": "no: no correction is predicted safe (Eq. 11)",
    "withheld": "no: the correction is not predicted safe, or changes no force",
    "late": "not asked: the assistant was late",
    "off": "off in this variant",
    "unknown": "not recorded",
}


def decision_lines(episode: Episode, t: int, width: int) -> list[Text]:
    """Set out one decision, in lines of at most `width` columns; a UsageError where the episode has no such decision."""
    return set_out(_parts(episode, decision_of(episode, t)), width)


def _parts(episode: Episode, facts: Decision) -> Iterator[RenderableType]:
    yield heading(f"{episode.label} · episode {episode.row['episode']} · decision {facts.t}", f"of 0 to {episode.decisions - 1}")
    yield _headline(episode, facts)
    yield ""
    yield fields(cell_fields(episode))
    yield from section("Action", _action(facts))
    if facts.safety is not None and facts.task is not None:
        yield from section("Gates", *_gates(episode, facts.safety, facts.task))
        yield from section("Plan", *_plan(episode, facts))
    elif facts.signal is not None:
        yield from section("Decision", *_signal(episode, facts))
    yield from section("What then happened", *_happened(episode, facts), fields([("decision time", _time(episode, facts))]))


def _headline(episode: Episode, facts: Decision) -> str:
    did = f"the command was changed by {facts.deviation:.3g}" if facts.intervened else "the command was executed"
    for name, gate, symbols in (("safety", facts.safety, ("G^c", "τ_c")), ("task", facts.task, ("ΔG", "τ_r"))):
        if gate is not None and gate.state == "fired":
            value, limit = beside(gate.value, gate.threshold)
            if facts.plan is not None and not facts.intervened:
                did = "the best correction was none, the command was executed"
            return f"The {name} gate fired ({symbols[0]} {value} > {symbols[1]} {limit}): {did}."
    if facts.gate == "late":
        return f"The assistant had not answered in time: {did}."
    if facts.gate == "method":
        return f"{decider(episode.method)} intervened: {did}."
    return f"No gate fired: {did}." if facts.safety is not None else f"{did.capitalize()}."


def _action(facts: Decision) -> RenderableType:
    how = "the command"
    if facts.intervened and facts.plan is None:
        how = "the method's own action"
    elif facts.intervened and facts.plan is not None:
        wished = [command + residual for command, residual in zip(facts.command, facts.plan.residuals[0], strict=True)]
        cut = ", cut off at the bounds" if any(abs(wish) > 1 + 1e-4 for wish in wished) else ""
        least = any(abs(min(max(wish, -1.0), 1.0) - done) > 1e-4 for wish, done in zip(wished, facts.executed, strict=True))
        how = f"command and first correction{cut}{', as the least action of that force' if least else ''} (Eq. 18)"
    rows = [
        ["command", action(facts.command), "a^H, from the operator"],
        ["executed", action(facts.executed), f"a, {how}"],
        ["deviation", f"{facts.deviation:.3g}", f"|a - a^H|, {'an' if facts.intervened else 'no'} intervention"],
    ]
    return table(["action", "value", "meaning"], rows)


def _gates(episode: Episode, safety: Gate, task: Gate) -> list[RenderableType]:
    rows: list[list[str]] = []
    styles: list[str] = []
    for look, gate, symbol, limit in ((LOOKS[GATE_SAFETY], safety, "G^c", "τ_c"), (LOOKS[GATE_TASK], task, "ΔG", "τ_r")):
        value, threshold = beside(gate.value, gate.threshold)
        rows.append([look.kind, f"{symbol} {value}", f"{limit} {threshold}", FIRES[gate.state]])
        styles.append(look.style if gate.state == "fired" else "")
    constants = episode.constants
    return [table(["gate", "value", "threshold", "fires"], rows, styles), *notes(cost_meaning(constants), gain_meaning(constants))]


def _signal(episode: Episode, facts: Decision) -> list[RenderableType]:
    signal, fired = episode.signal, facts.gate == "method"
    row = [signal.name, *beside(facts.signal, episode.signal_limit), short(episode.thresholds.tau_q), "yes" if fired else "no"]
    drawn = table(["signal", "value", "threshold", "τ_Q", "intervenes"], [row], [LOOKS[GATE_METHOD].style if fired else ""])
    return [drawn, *notes(f"{signal.name}: {signal.meaning}")]


def _plan(episode: Episode, facts: Decision) -> Iterator[RenderableType]:
    plan = facts.plan
    if plan is None:
        why = "the assistant was late" if facts.gate == "late" else "no gate fired"
        yield fields([("search", "not recorded" if facts.gate in ("safety", "task") else f"none: {why}")])
        return
    if plan.searched:
        known = episode.constants.batches
        cut = plan.safe.count(CUT_OFF)  # they stand before the iterations that were made; how many candidates these had is not recorded
        made = len(plan.safe) - cut
        sizes = [None] * made if known is None or cut else known[:made]
        rows = [
            [str(i + 1), "-" if size is None else str(size), str(safe), "II" if case2 else "I"]
            for i, (size, safe, case2) in enumerate(zip(sizes, plan.safe[cut:], plan.case2[cut:], strict=True))
        ]
        yield table(["iteration", "candidates", "safe (|F_s|)", "case"], rows)
        yield from notes(*(_case(episode, case2) for case2 in sorted(set(plan.case2[cut:]))))
        yield from notes(f"the search was cut off before its last {count(cut, 'iteration')}: its time was up" if cut else "")
    else:
        said = "none: the correction that the gate compared with the command is predicted safe, and is carried out"
        yield fields([("search", said)])
    yield from _corrections(episode, facts, plan)
    yield from _predicted(episode, facts, plan)


def _corrections(episode: Episode, facts: Decision, plan: Planned) -> list[RenderableType]:
    if plan.empty:
        return [fields([("correction", f"none: {_no_correction(episode, facts, plan)}")])]
    many = len(plan.residuals) if plan.searched else max(k for k, residual in enumerate(plan.residuals) if any(residual)) + 1
    rows = [[f"+{k}", action(residual), "not executed: planned again then"] for k, residual in enumerate(plan.residuals[:many])]
    rows[0][::2] = "now", "executed"
    return ["", table(["step", "correction δa (Eq. 13)", "use"], rows)]


def _case(episode: Episode, case2: bool) -> str:
    """What the planner makes of a batch of candidates."""
    feasible = episode.constants.feasible
    needed = "N_f" if feasible is None else f"N_f = {feasible}"
    if not case2:
        return f"Case I: at least {needed} candidates are safe (Eq. 14); the search maximizes predicted return (Eq. 16)"
    if episode.variant == "no-case2":
        return f"Case II: fewer than {needed} are safe; this variant has no recovery and goes on with these"
    return f"Case II: fewer than {needed} are safe (Eq. 14); the search minimizes predicted cost (Eq. 17)"


def _no_correction(episode: Episode, facts: Decision, plan: Planned) -> str:
    if episode.variant == "no-case2" and not any(plan.safe):
        return "no candidate was safe, and this variant has no recovery (Case II)"
    if facts.gate == "safety" and plan.alone_cost is not None and not exceeds(plan.alone_cost, episode.thresholds.tau_c):
        return "on a second look the command alone was predicted safe, and no correction was worth more"
    return "no candidate was predicted to be worth its size (Eq. 16-17)"


def _predicted(episode: Episode, facts: Decision, plan: Planned) -> list[RenderableType]:
    limit = episode.thresholds.tau_c
    sequences = [("command alone" if episode.constants.takeover else "commands alone", plan.alone_cost, plan.alone_return)]
    if not plan.empty:
        sequences.insert(0, ("with the correction", plan.cost, plan.return_))
    rows = []
    for name, cost, gain in sequences:
        value, bound = beside(cost, limit)
        within = "-" if cost is None or limit is None else f"no, above {bound}" if exceeds(cost, limit) else "yes"
        rows.append([name, value, within, short(gain)])
    # The printed WASP plans on the rollouts of its gates; a correction without a search is one of the futures that they compared.
    again = facts.gate == "safety" and plan.searched and episode.method != "printed"
    drawn = table(["predicted", "cost (G^c)", f"within τ_c {short(limit)}", "return (G^r)"], rows)
    return ["", drawn, *notes("the gate used other rollouts, so its G^c may differ" if again else "")]


def _happened(episode: Episode, facts: Decision) -> Iterator[RenderableType]:
    ahead, constants = facts.ahead, episode.constants
    rows = [
        [span(part.first, part.last), str(part.intervened), plain(part.reward, sign=True), *map(str, (part.cost, part.costly, part.goals))]
        for part in (facts.now, ahead)
    ]
    yield table(["decisions", "changed", "reward", "cost", "costly decisions", "goals"], rows)
    ended = ahead.last - ahead.first + 1 < facts.window
    yield from notes("cost: env steps with cost" + (f"; the episode ended before {facts.window} decisions" if ended else ""))
    # The gate's expectation beside what came, where both count the same.
    comparable = constants.horizon == facts.window and constants.bootstrap_cost is False
    if facts.safety is not None and facts.safety.value is not None and ahead.discounted is not None and comparable:
        came = f"observed{', with the interventions' if ahead.intervened else ''}"
        expected = "command, then the expert" if constants.takeover else "operator alone"
        rows = [[f"expected of the {expected} (G^c)", short(facts.safety.value)], [came, short(ahead.discounted)]]
        yield table(["costly decisions", f"discounted (γ_c {short(constants.gamma_c)})"], rows)


def _time(episode: Episode, facts: Decision) -> str:
    many = episode.episodes
    if facts.ms is None:
        return "not recorded"
    if many == 1:
        return ms(facts.ms)
    return f"{ms(facts.ms)}: the time of {many} episodes decided side by side, {ms(facts.ms * many)}, divided by {many}"
