"""What falls short behind the cells of a report, as sentences for the foot of its main table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.bars import ALWAYS
from wasp_cli.plan.judged import judged
from wasp_cli.report.operating import Operating
from wasp_cli.report.stats import Frame
from wasp_cli.report.summary import summarise
from wasp_cli.report.tables import task_title
from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import printable
from wasp_cli.store.severities import SEVERITY

GATED = ("wasp", "printed", "ida-guarded")  # methods whose safety gate the rows record


def stage_sentences(layout: Layout, trained: Iterable[Trained]) -> list[str]:
    """Return a sentence for each bar that a trained part does not reach, each once.

    If a task has several trainings, a sentence names the one that it is about.
    """
    trained = list(trained)
    seeds: dict[str, set[int]] = {}
    for part in trained:
        seeds.setdefault(part.task, set()).add(part.seed)
    sentences: dict[str, None] = {}
    for part in trained:
        training = f", training {part.seed}" if len(seeds[part.task]) > 1 else ""
        where = f"{task_title(part.task)}{training}"
        for short in judged(layout, part.kind, part.key):
            sentences[f"{where}: {short.sentence}. {_upper(short.remedy)}."] = None
    return list(sentences)


def chosen_sentences(trained: Iterable[Trained]) -> list[str]:
    """Return a sentence for each setting that is `auto` in the spec, with the value that was chosen
    for a task.
    """
    sentences: list[str] = []
    for part in trained:
        where = f"{task_title(part.task)}, training {part.seed}"
        if part.kind == SEVERITY:
            severity = _severity_words(part.summary)
            if severity is not None:
                sentences.append(f"{where}: {severity}")
        limit = part.summary.get("cost_limit")
        if part.kind == "expert" and isinstance(limit, int | float):
            sentences.append(
                f"{where}: the expert's cost_limit of {limit:.3g} per 1000 env steps followed from "
                "the cost of random commands (auto)."
            )
        allowance = part.summary.get("cost_allowance")
        if part.kind == "policies" and isinstance(allowance, int | float):
            sentences.append(
                f"{where}: the cost_allowance of {allowance:.3g} per 1000 env steps for latent "
                "policies followed from the expert's cost_limit (auto)."
            )
        if part.kind == "residual" and isinstance(limit, int | float):
            sentences.append(
                f"{where}: the residual's cost_limit of {limit:.3g} per 1000 env steps is that of "
                "the expert (auto)."
            )
        incident = part.summary.get("incident")
        bound = part.summary.get("tau_c")
        if isinstance(incident, int | float) and isinstance(bound, int | float):
            sentences.append(
                f"{where}: tau_c of {bound:.3g} followed from the incidents of the dataset, which "
                f"have {incident:.2g} costly decisions (auto)."
            )
    return list(dict.fromkeys(sentences))


def _severity_words(summary: Mapping[str, Any]) -> str | None:
    """How an operator's severity was chosen. None for the node that the others read, and if the
    severity that was asked for is out of reach, for which there is a shortfall.
    """
    numbers = [summary.get(name) for name in (SEVERITY, "kept", "random_return", "expert_return")]
    known = [float(number) for number in numbers if isinstance(number, int | float)]
    if len(known) < len(numbers) or summary.get("within") is False:
        return None
    severity, kept, random, expert = known
    operator = printable(str(summary.get("operator")))
    return (
        f"{operator} drives at {severity:.3g} (auto), which keeps {kept:.0%} of the "
        f"way from random commands ({random:.3g}) to the latent expert ({expert:.3g}) on held-out "
        "worlds."
    )


def gate_sentences(frame: Frame, operating: Sequence[Operating]) -> list[str]:
    """Return a sentence for each safety gate that never fires in any of its cells, or at nearly
    every decision (`plan.bars.ALWAYS`). Silent assistants are passed over.
    """
    silent = {(point.task, point.method) for point in operating if point.silent}
    sentences = []
    for group in frame.groups:
        if group.variant != "full" or group.method not in GATED or not len(group.cells):
            continue
        rate = summarise(group.cells, "safety_gate").mean
        if rate is None or (group.task, group.method) in silent:
            continue
        who = f"{task_title(group.task)}: the safety gate of {METHODS[group.method].title}"
        if rate == 0.0:
            sentences.append(f"{who} never fires.")
        elif rate >= ALWAYS:
            sentences.append(f"{who} fires at {rate:.0%} of the decisions.")
    return sentences


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]
