"""One decision in words."""

from __future__ import annotations

from rich.text import Text

from wasp_cli.report.explain.facts import Gate, Happened, Look, Planned, exceeds
from wasp_cli.report.explain.words import (
    STYLES,
    action,
    beside,
    count,
    decider,
    entry,
    expected_cost,
    ms,
    not_in_file,
    plain,
    rule,
    short,
    signal_of,
    span,
    title,
    whose,
)


def look_lines(look: Look, width: int) -> list[Text]:
    """One decision, in lines of at most `width` columns where words allow it."""
    who = look.who
    lines = [title(f"{who.label} · episode {who.episode} · decision {look.t}", f"of 0 to {who.decisions - 1}")]
    lines += whose(who, width)
    lines += [Text(), title("What was done")]
    lines += entry("command", f"{action(look.command)}  what the operator asked for (a^H)", width)
    lines += entry("executed", f"{action(look.executed)}  {_executed(look)}", width)
    what = f"the assistant changed the command by {look.deviation:.3g} (|a - a^H|)"
    lines += entry("deviation", f"{what}: an intervention" if look.intervened else "none: the command stood", width)

    lines += [Text(), title("Why")]
    if look.safety is not None and look.task is not None:
        lines += entry("safety gate", _safety(look, look.safety), width, STYLES["safety"] if look.safety.state == "fired" else "")
        lines += entry("task gate", _task(look, look.task), width, STYLES["task"] if look.task.state == "fired" else "")
        lines += [Text(), title("The plan"), *_plan(look, width)]
    else:
        lines += entry("rule", rule(who), width)
        if look.signal is not None:
            lines += entry(signal_of(who.method).name, _signal(look), width)

    lines += [Text(), title("What then happened")]
    lines += entry("this decision", _happened(look.now), width)
    lines += entry("and on", _ahead(look), width)
    compared = _foresight(look)
    lines += entry("foreseen", compared, width) if compared else []
    lines += [Text(), *entry("decision time", _time(look), width)]
    return lines + not_in_file(look.unknown, who, width)


def _executed(look: Look) -> str:
    if not look.intervened:
        return "as commanded (a)"
    if look.plan is None:
        return "what the assistant made of it (a)"
    wished = [command + residual for command, residual in zip(look.command, look.plan.residuals[0], strict=True)]
    cut = any(abs(wish - done) > 1e-4 for wish, done in zip(wished, look.executed, strict=True))
    return f"command and first correction{', cut off at the bounds' if cut else ''} (a, Eq. 18)"


def _safety(look: Look, gate: Gate) -> str:
    value, limit = beside(gate.value, gate.threshold)
    if gate.state == "off":
        return f"Switched off in this variant; its value would have been {value} (G^c, Eq. 9)."
    if gate.state == "unknown":
        return "Its value was not recorded (G^c, Eq. 9)."
    alone = f"If the operator goes on alone, {expected_cost(value, look.constants)} (G^c, Eq. 9)"
    if gate.state == "fired":
        return f"FIRED. {alone}: more than the {limit} that are allowed (τ_c)."
    return f"Silent. {alone}: {'more' if gate.above else 'no more'} than the {limit} that are allowed (τ_c)."


def _task(look: Look, gate: Gate) -> str:
    constants = look.constants
    value, limit = beside(gate.value, gate.threshold)
    tried = "" if constants.probe is None else f" of {constants.probe} that were tried"
    if gate.state == "off":
        return "Switched off in this variant."
    if gate.state == "unknown":
        return "Its value was not recorded (ΔG, Eq. 12)."
    if gate.state == "not asked":
        return "Not asked. Safety has priority, and the safety gate had fired."
    if gate.state == "no candidate":
        return f"Silent. None of the corrections{tried} was predicted to keep the cost within τ_c (Eq. 11), so there was no gain to weigh."
    gains = f"The best safe correction{tried} was expected to gain {value} return (ΔG, Eq. 12)"
    if gate.state == "fired":
        return f"FIRED. {gains}: more than {limit} (τ_r)."
    return f"Silent. {gains}: {'more' if gate.above else 'no more'} than {limit} (τ_r), so the command was left alone."


def _plan(look: Look, width: int) -> list[Text]:
    plan = look.plan
    if plan is None:
        fired = look.gate in ("safety", "task")
        why = "not recorded" if fired else "none: no gate had fired, and without a gate nothing is planned"
        return entry("search", f"{why}{' (the file has an older table version)' if fired and look.unknown else ''}", width)
    lines: list[Text] = []
    for i, (safe, case2) in enumerate(zip(plan.safe, plan.case2, strict=True)):
        # The probe of the task gate is the first batch of the search that it called for.
        size = look.constants.probe if i == 0 and look.gate == "task" else look.constants.candidates
        of = "" if size is None else f" of {size}"
        lines += entry(f"search step {i + 1}", f"{safe}{of} candidates predicted safe (|F_s|): Case {'II' if case2 else 'I'}", width)
    for case2 in sorted(set(plan.case2)):
        lines += entry(f"Case {'II' if case2 else 'I'}", _case(look, case2), width)
    if plan.nothing:
        lines += entry("correction", _no_correction(look, plan), width)
    else:
        chosen = "added to the command now, and to those that the operator is expected to give next (δa, Eq. 13);"
        lines += entry("correction", f"{chosen} only the first is executed before all is planned again", width)
        for k, residual in enumerate(plan.residuals):
            lines += entry("", f"{'now' if k == 0 else f'+{k}':<5}{action(residual)}", width)
    return lines + entry("predicted", _predicted(look, plan), width)


def _case(look: Look, case2: bool) -> str:
    """What the planner makes of a batch of candidates."""
    needed = "N_f" if look.constants.feasible is None else f"{look.constants.feasible}, N_f"
    if not case2:
        return f"enough of them are safe ({needed}; Eq. 14): on towards the highest predicted return among these (Eq. 16)"
    few = f"too few of them are safe (less than {needed}; Eq. 14)"
    if look.who.assistant_variant == "no-case2":
        return f"{few}: this variant has no recovery, and goes on with those it has"
    return f"{few}: on towards less predicted cost first of all (Eq. 17)"


def _no_correction(look: Look, plan: Planned) -> str:
    limit = None if look.safety is None else look.safety.threshold
    if look.who.assistant_variant == "no-case2" and not any(plan.safe):
        return "none: no candidate was safe, and this variant has no recovery (Case II). The command stood."
    if look.gate == "safety" and plan.alone_cost is not None and not exceeds(plan.alone_cost, limit):
        return "none: on a second look the command alone was predicted safe after all, and no correction was worth more. The command stood."
    return "none: nothing that was tried was predicted to be worth its size (Eq. 16-17). The command stood."


def _predicted(look: Look, plan: Planned) -> str:
    alone = f"cost {short(plan.alone_cost)} (G^c), return {short(plan.alone_return)} (G^r)"
    if plan.nothing:
        text = f"{alone} with the commands alone"
    else:
        text = f"with the correction cost {short(plan.cost)}, return {short(plan.return_)}; with the commands alone {alone}"
    limit = None if look.safety is None else look.safety.threshold
    if plan.cost is not None and limit is not None:
        value, bound = beside(plan.cost, limit)
        above = exceeds(plan.cost, limit)
        text += f". {'So' if plan.nothing else 'With it'} the cost {'is still above' if above else 'stays within'} τ_c"
        text += f" ({value} against {bound})"
    if look.gate == "safety":
        text += ". These are other imagined futures than the gate's, so that G^c may differ from the gate's"
    return text + "."


def _signal(look: Look) -> str:
    value, limit = beside(look.signal, look.signal_limit)
    meaning, method = signal_of(look.who.method).meaning, look.who.method
    above = "" if look.signal_limit is None else f"; {decider(method)} intervenes above {limit}"
    margin = "" if look.tau_q is None else f" (τ_Q = {short(look.tau_q)})"
    does = "it intervened" if look.gate == "method" else "the command stood"
    return f"{value}, {meaning}{margin}{above}: {does}"


def _happened(what: Happened) -> str:
    cost = f"cost in {count(what.cost, 'env step')}" if what.cost else "no cost"
    if what.cost and what.decisions > 1:
        cost += f" of {count(what.costly, 'decision')}"
    goals = f", {count(what.goals, 'goal')} reached" if what.goals else ""
    return f"reward {plain(what.reward, sign=True)}, {cost}{goals}"


def _ahead(look: Look) -> str:
    ahead = look.ahead
    left = "" if ahead.decisions == look.window else f"; the episode ended before the {look.window} were full"
    helped = f", {ahead.intervened} of them with an intervention" if ahead.intervened else ", none with an intervention"
    counted = f"{count(ahead.decisions, 'decision')} from this one on ({span(ahead.first, ahead.last)}{helped}{left})"
    return f"{counted}: {_happened(ahead)}"


def _foresight(look: Look) -> str:
    """The gate's expectation beside what came; empty where they do not count the same."""
    comparable = look.constants.horizon == look.window and look.constants.bootstrap_cost is False
    if look.safety is None or look.safety.value is None or look.ahead.discounted is None or not comparable:
        return ""
    text = f"G^c expected {short(look.safety.value)} costly decisions of the operator alone; {short(look.ahead.discounted)} came"
    text += f", both discounted by {short(look.constants.gamma_c)} per decision (γ_c)"
    return text + (". What came includes what the assistant did" if look.ahead.intervened else "")


def _time(look: Look) -> str:
    many = look.who.episodes
    if look.ms is None:
        return "not recorded"
    if many == 1:
        return ms(look.ms)
    shared = (
        f"the {many} episodes of the cell are decided side by side, and this is their common time, {ms(look.ms * many)}, divided by {many}"
    )
    return f"{ms(look.ms)}: {shared}. One episode alone takes something in between"
