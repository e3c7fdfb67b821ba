"""One decision as tables: the action, the gates, the plan, and what then happened."""

from __future__ import annotations

from rich.text import Text

from wasp_cli.metrics.episode import CUT_OFF
from wasp_cli.report.explain.facts import DecisionFacts, Gate, Planned, exceeds
from wasp_cli.report.explain.layout import (
    STYLES,
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
    sentence,
    short,
    span,
    table,
)
from wasp_cli.report.explain.stored import signal_of

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


def decision_lines(facts: DecisionFacts, width: int) -> list[Text]:
    """Set out one decision, in lines of at most `width` columns where words allow it."""
    who = facts.who
    lines = [
        heading(f"{who.label} · episode {who.episode} · decision {facts.t}", f"of 0 to {who.decisions - 1}"),
        *sentence(_headline(facts), width),
    ]
    lines += [Text(), *fields(cell_fields(who), width)]
    lines += [Text(), heading("Action"), *_action(facts, width)]
    if facts.safety is not None and facts.task is not None:
        lines += [Text(), heading("Gates"), *_gates(facts, facts.safety, facts.task, width)]
        lines += [Text(), heading("Plan"), *_plan(facts, width)]
    elif facts.signal is not None:
        lines += [Text(), heading("Decision"), *_signal(facts, width)]
    return [*lines, Text(), heading("What then happened"), *_happened(facts, width), *fields([("decision time", _time(facts))], width)]


def _headline(facts: DecisionFacts) -> str:
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
        return f"{decider(facts.who.method)} intervened: {did}."
    return f"No gate fired: {did}." if facts.safety is not None else f"{did.capitalize()}."


def _action(facts: DecisionFacts, width: int) -> list[Text]:
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
    return table(["action", "value", "meaning"], rows, width)


def _gates(facts: DecisionFacts, safety: Gate, task: Gate, width: int) -> list[Text]:
    rows = []
    for name, gate, symbol, limit in (("safety", safety, "G^c", "τ_c"), ("task", task, "ΔG", "τ_r")):
        value, threshold = beside(gate.value, gate.threshold)
        rows.append([name, f"{symbol} {value}", f"{limit} {threshold}", FIRES[gate.state]])
    styles = [STYLES[name] if gate.state == "fired" else "" for name, gate in (("safety", safety), ("task", task))]
    lines = table(["gate", "value", "threshold", "fires"], rows, width, styles)
    return lines + notes(width, cost_meaning(facts.constants), gain_meaning(facts.constants))


def _signal(facts: DecisionFacts, width: int) -> list[Text]:
    signal, fired = signal_of(facts.who.method), facts.gate == "method"
    row = [signal.name, *beside(facts.signal, facts.signal_limit), short(facts.tau_q), "yes" if fired else "no"]
    lines = table(["signal", "value", "threshold", "τ_Q", "intervenes"], [row], width, [STYLES["method"] if fired else ""])
    return lines + notes(width, f"{signal.name}: {signal.meaning}")


def _plan(facts: DecisionFacts, width: int) -> list[Text]:
    plan = facts.plan
    if plan is None:
        fired = facts.gate in ("safety", "task")
        why = "the assistant was late" if facts.gate == "late" else "no gate fired"
        return fields([("search", "not recorded" if fired else f"none: {why}")], width)
    if not plan.searched:
        said = [("search", "none: the correction that the gate compared with the command is predicted safe, and is carried out")]
        return fields(said, width) + _corrections(facts, plan, width) + _predicted(facts, plan, width)
    known = facts.constants.batches
    cut = plan.safe.count(CUT_OFF)  # they stand before the iterations that were made; how many candidates these had is not recorded then
    made = len(plan.safe) - cut
    sizes = [None] * made if known is None or cut else known[:made]
    rows = [
        [str(i + 1), "-" if size is None else str(size), str(safe), "II" if case2 else "I"]
        for i, (size, safe, case2) in enumerate(zip(sizes, plan.safe[cut:], plan.case2[cut:], strict=True))
    ]
    lines = table(["iteration", "candidates", "safe (|F_s|)", "case"], rows, width)
    lines += notes(width, *(_case(facts, case2) for case2 in sorted(set(plan.case2[cut:]))))
    lines += notes(width, f"the search was cut off before its last {count(cut, 'iteration')}: its time was up" if cut else "")
    return lines + _corrections(facts, plan, width) + _predicted(facts, plan, width)


def _corrections(facts: DecisionFacts, plan: Planned, width: int) -> list[Text]:
    if plan.empty:
        return fields([("correction", f"none: {_no_correction(facts, plan)}")], width)
    many = len(plan.residuals) if plan.searched else max(k for k, residual in enumerate(plan.residuals) if any(residual)) + 1
    rows = [[f"+{k}", action(residual), "not executed: planned again then"] for k, residual in enumerate(plan.residuals[:many])]
    rows[0][::2] = "now", "executed"
    return [Text(), *table(["step", "correction δa (Eq. 13)", "use"], rows, width)]


def _case(facts: DecisionFacts, case2: bool) -> str:
    """What the planner makes of a batch of candidates."""
    needed = "N_f" if facts.constants.feasible is None else f"N_f = {facts.constants.feasible}"
    if not case2:
        return f"Case I: at least {needed} candidates are safe (Eq. 14); the search maximizes predicted return (Eq. 16)"
    if facts.who.variant == "no-case2":
        return f"Case II: fewer than {needed} are safe; this variant has no recovery and goes on with these"
    return f"Case II: fewer than {needed} are safe (Eq. 14); the search minimizes predicted cost (Eq. 17)"


def _no_correction(facts: DecisionFacts, plan: Planned) -> str:
    limit = None if facts.safety is None else facts.safety.threshold
    if facts.who.variant == "no-case2" and not any(plan.safe):
        return "no candidate was safe, and this variant has no recovery (Case II)"
    if facts.gate == "safety" and plan.alone_cost is not None and not exceeds(plan.alone_cost, limit):
        return "on a second look the command alone was predicted safe, and no correction was worth more"
    return "no candidate was predicted to be worth its size (Eq. 16-17)"


def _predicted(facts: DecisionFacts, plan: Planned, width: int) -> list[Text]:
    limit = None if facts.safety is None else facts.safety.threshold
    sequences = [("command alone" if facts.constants.takeover else "commands alone", plan.alone_cost, plan.alone_return)]
    if not plan.empty:
        sequences.insert(0, ("with the correction", plan.cost, plan.return_))
    rows = []
    for name, cost, gain in sequences:
        value, bound = beside(cost, limit)
        within = "-" if cost is None or limit is None else f"no, above {bound}" if exceeds(cost, limit) else "yes"
        rows.append([name, value, within, short(gain)])
    # The printed WASP plans on the rollouts of its gates; a correction without a search is one of the futures that they compared.
    again = facts.gate == "safety" and plan.searched and facts.who.method != "printed"
    lines = [Text()]
    lines += table(["predicted", "cost (G^c)", f"within τ_c {short(limit)}", "return (G^r)"], rows, width)
    return lines + notes(width, "the gate used other rollouts, so its G^c may differ" if again else "")


def _happened(facts: DecisionFacts, width: int) -> list[Text]:
    ahead = facts.ahead
    rows = [
        [span(part.first, part.last), str(part.intervened), plain(part.reward, sign=True), *map(str, (part.cost, part.costly, part.goals))]
        for part in (facts.now, ahead)
    ]
    lines = table(["decisions", "changed", "reward", "cost", "costly decisions", "goals"], rows, width)
    ended = "" if ahead.decisions == facts.window else f"; the episode ended before {facts.window} decisions"
    lines += notes(width, f"cost: env steps with cost{ended}")
    # The gate's expectation beside what came, where both count the same.
    comparable = facts.constants.horizon == facts.window and facts.constants.bootstrap_cost is False
    if facts.safety is not None and facts.safety.value is not None and ahead.discounted is not None and comparable:
        came = f"observed{', with the interventions' if ahead.intervened else ''}"
        expected = "command, then the expert" if facts.constants.takeover else "operator alone"
        rows = [[f"expected of the {expected} (G^c)", short(facts.safety.value)], [came, short(ahead.discounted)]]
        lines += table(["costly decisions", f"discounted (γ_c {short(facts.constants.gamma_c)})"], rows, width)
    return lines


def _time(facts: DecisionFacts) -> str:
    many = facts.who.episodes
    if facts.ms is None:
        return "not recorded"
    if many == 1:
        return ms(facts.ms)
    return f"{ms(facts.ms)}: the time of {many} episodes decided side by side, {ms(facts.ms * many)}, divided by {many}"
